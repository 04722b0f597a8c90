"""How ROS 2 speaks on Zenoh: keys, tokens and attachments as text and bytes; no session."""
