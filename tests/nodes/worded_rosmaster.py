#!/usr/bin/python3
"""A real rosmaster whose answers have other words, like that of a vendor who has patched it."""

import rosmaster
from rosmaster.master_api import ROSMasterHandler


def worded(method):
    """Wraps a method so that it answers with another text."""

    def call(self, *arguments):
        code, message, value = method(self, *arguments)
        return code, "vendor: " + message, value

    return call


for name in [
    "deleteParam",
    "getParam",
    "getSystemState",
    "getTopicTypes",
    "lookupNode",
    "lookupService",
    "registerPublisher",
    "registerService",
    "registerSubscriber",
    "setParam",
    "subscribeParam",
    "unregisterPublisher",
    "unregisterSubscriber",
]:
    setattr(ROSMasterHandler, name, worded(getattr(ROSMasterHandler, name)))
rosmaster.rosmaster_main()
