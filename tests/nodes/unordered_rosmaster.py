#!/usr/bin/python3
"""A real rosmaster whose dictionaries have no defined order, as on Python 2, and which reports to run on Python 2."""

import zlib
from xmlrpc.client import Marshaller
from xmlrpc.server import SimpleXMLRPCRequestHandler

import rosmaster
from rosmaster.master_api import ROSMasterHandler


def hashed(item):
    """The sort key of a name, or of a list that starts with one."""
    name = item if isinstance(item, str) else item[0]
    return zlib.crc32(name.encode())


def shuffled(method, lists):
    """Wraps a method so that the lists in its answer are in another order."""

    def call(self, *arguments):
        code, message, value = method(self, *arguments)
        if code == 1:
            value = lists(value)
        return code, message, value

    return call


def one(value):
    return sorted(value, key=hashed)


for name in ["getTopicTypes", "getPublishedTopics", "getParamNames"]:
    setattr(ROSMasterHandler, name, shuffled(getattr(ROSMasterHandler, name), one))
state = shuffled(ROSMasterHandler.getSystemState, lambda value: [one(it) for it in value])
ROSMasterHandler.getSystemState = state

dump_struct = Marshaller.dispatch[dict]
Marshaller.dispatch[dict] = lambda self, value, write: dump_struct(
    self, {key: value[key] for key in one(value)}, write
)
SimpleXMLRPCRequestHandler.server_version = "BaseHTTP/0.3"
SimpleXMLRPCRequestHandler.sys_version = "Python/2.7.18"
rosmaster.rosmaster_main()
