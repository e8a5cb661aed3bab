#!/usr/bin/python3
"""A real rosmaster that dies between changing its state and notifying nodes of the change.

The file `$ROS_HOME/die-at` says when, as `TASK N`: TASK is publisherUpdate (for the topic /chatter) or paramUpdate (for
the key /gain). With N = 0 it dies before any callback of the next change is queued, otherwise when the Nth callback is
about to be sent. It removes the file then, so the next master lives.
"""

import os
import threading

import rosmaster
import rosmaster.master_api as api

_lock = threading.Lock()
_sent = {"publisherUpdate": 0, "paramUpdate": 0}


def maybe_die(task, point):
    """Dies if this is the right moment. `point` is None for the next callback."""
    path = os.path.join(os.environ["ROS_HOME"], "die-at")
    with _lock:
        try:
            with open(path) as file:
                wanted, number = file.read().split()
        except IOError:  # FileNotFoundError in Python 3
            return
        if wanted != task:
            return
        if point is None:
            _sent[task] += 1
            point = _sent[task]
        if point == int(number):
            os.unlink(path)
            os._exit(1)


def before(original, task, point, concerns):
    def wrapped(*arguments):
        if concerns(*arguments):
            maybe_die(task, point)
        return original(*arguments)

    return wrapped


handler = api.ROSMasterHandler
handler._notify_topic_subscribers = before(
    handler._notify_topic_subscribers,
    "publisherUpdate",
    0,
    lambda _self, topic, _publishers, subscribers: topic == "/chatter" and subscribers,
)
api.publisher_update_task = before(
    api.publisher_update_task,
    "publisherUpdate",
    None,
    lambda _api, topic, _publishers: topic == "/chatter",
)
handler._notify_param_subscribers = before(
    handler._notify_param_subscribers,
    "paramUpdate",
    0,
    lambda _self, updates: any(key == "/gain/" for _subscribers, key, _value in updates),
)
handler.param_update_task = before(
    handler.param_update_task,
    "paramUpdate",
    None,
    lambda _self, _id, _api, key, _value: key == "/gain/",
)

rosmaster.rosmaster_main()
