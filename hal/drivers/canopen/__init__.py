"""CANopen nodes: what every node has, and sensors of the profiles CiA 401, 404 and 406."""
