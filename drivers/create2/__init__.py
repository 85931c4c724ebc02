"""The iRobot Create 2 and the Roomba 500 and 600 over a serial cable: codec, odometry, options and driver."""
