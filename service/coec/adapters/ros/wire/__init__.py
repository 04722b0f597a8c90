"""Wire format of ROS 2 on Zenoh: keys, tokens and attachments as text and bytes, without a session."""
