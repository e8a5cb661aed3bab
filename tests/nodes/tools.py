#!/usr/bin/python3
"""Runs command line tools of ROS, one after another, and imports what they need only once. Usage: tools.py RUNS

RUNS is a JSON list of argument lists, each with the name of the tool first. It prints a JSON list with the wait status,
the standard output and the standard error of each run. A tool's own program contains nothing but the call that is made
here.
"""

import json
import os
import sys
import tempfile

import rosbag  # pylint: disable=unused-import  # rostopic imports it when it runs
import rosnode
import rosparam
import rosservice
import rostopic

MAINS = {
    "rosnode": rosnode.rosnodemain,
    "rosparam": rosparam.yamlmain,
    "rosservice": rosservice.rosservicemain,
    "rostopic": rostopic.rostopicmain,
}


def main():
    runs = json.loads(sys.argv[1])
    results = []
    for argv in runs:
        outputs = [tempfile.TemporaryFile(), tempfile.TemporaryFile()]
        child = os.fork()
        if child == 0:
            for descriptor, output in enumerate(outputs, 1):
                os.dup2(output.fileno(), descriptor)
            sys.argv = [str(word) for word in argv]
            # Not os._exit: a tool that is a node ends in its exit handlers.
            return MAINS[argv[0]](sys.argv)
        result = [os.waitpid(child, 0)[1]]
        for output in outputs:
            output.seek(0)
            result.append(output.read().decode("utf-8"))
            output.close()
        results.append(result)
    print(json.dumps(results))


if __name__ == "__main__":
    main()
