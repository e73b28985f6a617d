"""ROS 2 without ROS: the wire format of rmw_zenoh, a bridge of a robot's messages, and drivers that are ROS 2 nodes."""
