#!/usr/bin/python3
"""A real rosmaster whose port another program takes first. If there is a file `rob` in `ROS_HOME`, it writes its port
into the file `port` there, and starts only when another program listens at that port."""

import os
import socket
import sys
import time

import rosmaster

home = os.environ["ROS_HOME"]
port = sys.argv[sys.argv.index("-p") + 1]
if os.path.exists(os.path.join(home, "rob")):
    said = os.path.join(home, "port")
    with open(said + ".new", "w") as file:
        file.write(port)
    os.rename(said + ".new", said)
    while socket.socket().connect_ex(("127.0.0.1", int(port))):
        time.sleep(0.01)
rosmaster.rosmaster_main()
