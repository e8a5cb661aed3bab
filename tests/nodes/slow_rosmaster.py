#!/usr/bin/python3
"""A rosmaster that takes its time for each call: so many seconds as the file `slow` in `ROS_HOME` says, or if
that names a method too, for requests in which it occurs."""

import os
import time
from xmlrpc.server import SimpleXMLRPCDispatcher

import rosmaster

_dispatch = SimpleXMLRPCDispatcher._marshaled_dispatch


def slow_dispatch(self, data, *arguments, **options):
    """Waits, then does what is to be done."""
    try:
        with open(os.path.join(os.environ["ROS_HOME"], "slow")) as seconds:
            seconds, *method = (seconds.read() or "0").split()
        if not method or method[0].encode() in data:
            time.sleep(float(seconds))
    except OSError:
        pass
    return _dispatch(self, data, *arguments, **options)


SimpleXMLRPCDispatcher._marshaled_dispatch = slow_dispatch
rosmaster.rosmaster_main()
