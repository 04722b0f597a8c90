"""ROS 2 bags: files and folders of messages (`storage`), and the recording of one pair in them."""
