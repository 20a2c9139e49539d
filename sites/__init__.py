"""Runs live sessions, in which several robot arms are coupled over a network.

Each arm is controlled by a process of its own, its site. A site joins the session together with
the other sites, runs the control loop of its arm at a fixed rate, exchanges the state of the
arm with the other sites in every period, and leaves at the end. The package also contains the
programs around a session, such as those that start it, move an arm, or measure the network.
"""
