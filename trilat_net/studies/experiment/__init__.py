"""Former places of names of `trilat_people.experiment`."""
