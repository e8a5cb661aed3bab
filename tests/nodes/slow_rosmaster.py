#!/usr/bin/python3
"""A rosmaster that is slow. The file `slow` in `ROS_HOME` has the number of seconds for each call. If it also names a
method, only requests that mention the method are slow. A call goes on when the file is gone."""

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
        path = os.path.join(os.environ["ROS_HOME"], "slow")
        with open(path) as seconds:
            words = (seconds.read() or "0").split()
        if len(words) == 1 or words[1].encode() in data:
            end = time.time() + float(words[0])
            while time.time() < end and os.path.exists(path):
                time.sleep(min(0.02, max(0, end - time.time())))
    except (IOError, OSError):  # one in Python 3
        pass
    return _dispatch(self, data, *arguments, **options)


SimpleXMLRPCDispatcher._marshaled_dispatch = slow_dispatch
rosmaster.rosmaster_main()
