"""What a run was like, in numbers: how well it followed, what it cost, what was felt."""
