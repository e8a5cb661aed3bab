#!/usr/bin/python3
"""A rosmaster that is slow. The file `slow` in `ROS_HOME` has the number of seconds for each call. If it also names a
method, only requests that mention the method are slow."""

import os
import time

try:
    from xmlrpc.server import SimpleXMLRPCDispatcher
except ImportError:
    from SimpleXMLRPCServer import SimpleXMLRPCDispatcher

import rosmaster

_dispatch = SimpleXMLRPCDispatcher._marshaled_dispatch


def slow_dispatch(self, data, *arguments, **options):
    """Waits, then runs the call."""
    try:
        with open(os.path.join(os.environ["ROS_HOME"], "slow")) as seconds:
            words = (seconds.read() or "0").split()
        if len(words) == 1 or words[1].encode() in data:
            time.sleep(float(words[0]))
    except (IOError, OSError):  # one in Python 3
        pass
    return _dispatch(self, data, *arguments, **options)


SimpleXMLRPCDispatcher._marshaled_dispatch = slow_dispatch
rosmaster.rosmaster_main()
