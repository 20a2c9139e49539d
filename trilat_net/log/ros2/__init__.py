"""Standard ROS 2 messages of a session: encoding, content, and channels for viewers."""
