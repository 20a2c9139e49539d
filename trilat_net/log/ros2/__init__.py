"""Standard ROS 2 messages of a session: their encoding, their content, and the channels for
viewers.
"""
