"""ROS 2 messages in CDR."""
