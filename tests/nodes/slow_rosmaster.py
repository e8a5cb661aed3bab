#!/usr/bin/python3
"""A rosmaster that takes its time for each call: so many seconds as the file `slow` in `ROS_HOME` says."""

import os
import time
from xmlrpc.server import SimpleXMLRPCDispatcher

import rosmaster

_dispatch = SimpleXMLRPCDispatcher._marshaled_dispatch


def slow_dispatch(self, *arguments, **options):
    """Waits, then does what is to be done."""
    try:
        with open(os.path.join(os.environ["ROS_HOME"], "slow")) as seconds:
            time.sleep(float(seconds.read() or 0))
    except OSError:
        pass
    return _dispatch(self, *arguments, **options)


SimpleXMLRPCDispatcher._marshaled_dispatch = slow_dispatch
rosmaster.rosmaster_main()
