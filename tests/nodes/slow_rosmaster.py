#!/usr/bin/python3
"""A rosmaster that takes its time for each call: so many seconds as the file `slow` in `ROS_HOME` says, or if
that names a method too, for requests in which it occurs."""

import os
import time

try:
    from xmlrpc.server import SimpleXMLRPCDispatcher
except ImportError:
    from SimpleXMLRPCServer import SimpleXMLRPCDispatcher

import rosmaster

_dispatch = SimpleXMLRPCDispatcher._marshaled_dispatch


def slow_dispatch(self, data, *arguments, **options):
    """Waits, then does what is to be done."""
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
