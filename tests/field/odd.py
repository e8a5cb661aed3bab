#!/usr/bin/python3
"""Counts odd requests that rosrescue answers with the bytes of a bare rosmaster: forwarded, and while it stands in.

    tests/field/odd.py ROSRESCUE [ROSMASTER…]

prints a table as Markdown, and the requests with another answer on standard error. ROSMASTER starts a master of another
release, for example `chroot FOLDER rosmaster`.

They are requests that no ROS client sends, but tools, scanners and other XML-RPC libraries do.
"""

import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
import xmlrpc.client

rosrescue = sys.argv[1]
rosmaster = sys.argv[2:] or ["rosmaster"]

METHODS = """getPid getUri shutdown registerPublisher unregisterPublisher registerSubscriber unregisterSubscriber
registerService unregisterService lookupService lookupNode getPublishedTopics getTopicTypes getSystemState setParam
deleteParam getParam hasParam searchParam getParamNames subscribeParam unsubscribeParam""".split()
UNKNOWN = """system.listMethods system.methodHelp system.methodSignature getMasterUri getBusInfo getPublications
publisherUpdate _shutdown uri services thread __class__ a.b""".split() + ["", " getPid", "é"]
VALUES = """<nil/> <nil></nil> <ex:nil/> <i1>1</i1> <i2>1</i2> <i4>1</i4> <i8>1</i8> <i8>99999999999</i8> <ex:i8>1</ex:i8>
<biginteger>1</biginteger> <bigdecimal>1.5</bigdecimal> <int>1</int> <int>+1</int> <int>-0</int> <int>007</int> <int>1_000</int>
<int>2147483647</int> <int>2147483648</int> <int>-2147483649</int> <int>five</int> <int></int> <int/> <int>1.0</int> <int>0x10</int>
<int>١</int> <double>1,5</double> <double>1e400</double> <double>nan</double> <double>-inf</double> <double>.5</double> <double>1_0.5</double>
<double></double> <float>1.5</float> <boolean>1</boolean> <boolean>2</boolean> <boolean>true</boolean> <boolean></boolean>
<string/> <string></string> <string>&amp;</string> <string>&lt;b&gt;</string> <string>&nbsp;</string> <string>&#65;</string>
<string>&#0;</string> <string>]]</string> <string><![CDATA[<b>]]></string> <string>1</int> <base64>AAAA</base64> <base64>A</base64>
<base64>!!</base64> <base64/> <dateTime.iso8601>20260101T00:00:00</dateTime.iso8601> <dateTime.iso8601>now</dateTime.iso8601>
<unknown>1</unknown> <array/> <array><data/></array> <array><data></data></array> <array><data><value/></data></array>
<array><value>1</value></array> <struct/> <struct></struct> <struct><member/></struct> <struct><member><name>a</name></member></struct>
<struct><member><value>1</value></member></struct> <struct><member><name>a</name><value>1</value></member></struct>
<struct><member><name>a/b</name><value>1</value></member></struct> <struct><member><name></name><value>1</value></member></struct>
<value>1</value> <params/> <!--c--> <?pi?>""".split() + [" ", "\n", "text", "<int> 1 </int>", "<double> 1 </double>"]


def call(method, *values):
    params = "".join("<param><value>%s</value></param>" % value for value in values)
    return "<methodCall><methodName>%s</methodName><params>%s</params></methodCall>" % (method, params)


def bodies():
    """Bodies of requests."""
    for method in METHODS:
        for values in [[], ["/n"], ["<int>1</int>"], ["/n", "<int>1</int>"], ["/n"] * 6]:
            # With two arguments of any type this call ends the master.
            if (method, len(values)) != ("shutdown", 2):
                yield call(method, *values)
    for method in UNKNOWN:
        yield call(method, "/n")
    for value in VALUES:
        yield call("setParam", "/n", "/value", value)
        yield call("getParam", "/n", "/value")
    for name in ["", "/", "~a", "a b", "1", "/a//b", "é", "%", "/a/"]:
        yield call("getParam", "/n", name)
        yield call("lookupNode", "/n", name)
    entry = "<struct><member><name>methodName</name><value>%s</value></member>" \
        "<member><name>params</name><value><array><data><value>/n</value></data></array></value></member></struct>"
    for entries in [["<int>1</int>"], ["<array/>"], ["<struct/>"], [entry % "no"], [entry % "getParamNames"], [entry % "shutdown"],
                    [entry % "system.multicall"], [entry % "getParamNames", "x"], []]:
        data = "".join("<value>%s</value>" % item for item in entries)
        yield call("system.multicall", "<array><data>%s</data></array>" % data)
    whole = call("getParamNames", "/n")
    yield from ["", "\n ", "garbage", "<", "<methodCall>", "<methodCall/>", whole + "<more/>", whole + "more", whole[:-1],
                "<!DOCTYPE methodCall>" + whole, "<?xml version='1.0'?><!DOCTYPE methodCall >" + whole, " <?xml version='1.0'?>" + whole,
                "<?xml version='1.0' encoding='latin1'?>" + whole, "<?xml version='1.0' encoding='none'?>" + whole, "\ufeff" + whole,
                "<!ENTITY a 'b'>" + whole, "<!-- c -->" + whole, whole.upper(), "<a>" + whole + "</a>", whole + whole,
                "<methodResponse><params/></methodResponse>", "<methodCall><methodName>getPid</methodName></methodCall>",
                "<methodCall><params/></methodCall>", "\0" + whole, "{}"]


def requests():
    """Whole requests, each with its text for people."""
    def http(body, line="POST /RPC2 HTTP/1.1", headers=("Content-Type: text/xml",), length="%d"):
        lines = [line, "Host: localhost", "Connection: close", *headers, "Content-Length: " + length % len(body) if length else ""]
        return "\r\n".join(filter(None, lines)).encode() + b"\r\n\r\n" + body

    for body in bodies():
        yield body, http(body.encode())
    whole = call("getParamNames", "/n").encode()
    for encoding in ["utf-16", "utf-8-sig"]:
        yield encoding, http(whole.decode().encode(encoding))
    for kind in ["text/plain", "application/xml", "application/json", "text/xml; charset=utf-8", "x", ""]:
        yield "content type " + kind, http(whole, headers=["Content-Type: " + kind])
    yield "no content type", http(whole, headers=[])
    for line in ["POST / HTTP/1.1", "POST /RPC2 HTTP/1.0", "POST /x HTTP/1.1", "POST /rpc2 HTTP/1.1", "POST  /RPC2 HTTP/1.1",
                 "PUT /RPC2 HTTP/1.1", "DELETE / HTTP/1.1", "BREW / HTTP/1.1", "OPTIONS / HTTP/1.1", "POST /RPC2 HTTP/9.9", "POST /RPC2"]:
        yield line, http(whole, line=line)
    for length in ["+%d", "0%d", " %d ", "-%d", "x%d", "%d, 1"]:
        yield "Content-Length: " + length, http(whole, length=length)
    for header in ["X-A: b\r\n c", "X-A:b", "X_A: b", "X-A: é", "Accept-Encoding: gzip", "Content-Encoding: x", "Content-Encoding: gzip",
                   "Expect: 200-x", "User-Agent: " + "x" * 4000]:
        yield header[:40], http(whole, headers=["Content-Type: text/xml", header])


def exchange(port, request):
    """The status and the body of the answer."""
    try:
        with socket.create_connection(("127.0.0.1", port)) as stream:
            stream.settimeout(3)
            stream.sendall(request)
            answer = b""
            while more := stream.recv(1 << 16):
                answer += more
    except OSError as error:
        return type(error).__name__
    head, _, body = answer.partition(b"\r\n\r\n")
    status = head.split(b"\r\n")[0].split(b" ", 1)[-1]
    return status, body


def free_port():
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


def start(*command, port):
    process = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 60
    while True:
        try:
            return process, xmlrpc.client.ServerProxy("http://127.0.0.1:%d" % port).getPid("/odd")[2]
        except OSError:
            assert time.monotonic() < deadline, command
            time.sleep(0.1)


def plain(answer, pid, port):
    """The answer without what differs between two masters."""
    return str(answer).replace("<int>%d</int>" % pid, "PID").replace(":%d" % port, ":PORT")


with tempfile.TemporaryDirectory() as scratch:
    environment = dict(os.environ, ROS_HOME=scratch, ROS_LOG_DIR=scratch, ROS_IP="127.0.0.1")
    environment.pop("ROS_MASTER_URI", None)
    print("| | the same bytes |\n|---|--:|")
    for title in ["forwarded", "standing in"]:
        processes = []
        try:
            bare, behind, ours = free_port(), free_port(), free_port()
            begun, bare_pid = start(*rosmaster, "--core", "-p", str(bare), port=bare)
            processes.append(begun)
            master, _ = start(*rosmaster, "--core", "-p", str(behind), port=behind)
            processes.append(master)
            command = [rosrescue, "proxy", "--master", "http://127.0.0.1:%d" % behind, "--listen", "127.0.0.1:%d" % ours]
            begun, _ = start(*command, "--checkpoint", os.path.join(scratch, title), "--hold", "1", port=ours)
            processes.append(begun)
            # It takes a write, and knows the master's process, only after it has the master's state.
            for port in [bare, ours]:
                client = xmlrpc.client.ServerProxy("http://127.0.0.1:%d" % port)
                assert client.setParam("/odd", "/ready", True)[0] == 1
                pid = client.getPid("/odd")[2]
            if title == "standing in":
                master.kill()
                master.wait()
            count = same = 0
            for text, request in requests():
                theirs = plain(exchange(bare, request), bare_pid, bare)
                answer = plain(exchange(ours, request), pid, ours)
                count += 1
                same += answer == theirs
                if answer != theirs:
                    print("%s\n%s\n  rosmaster: %s\n  rosrescue: %s" % (title, text, theirs[:300], answer[:300]), file=sys.stderr)
            print("| %s | %d of %d |" % (title, same, count), flush=True)
        finally:
            for process in reversed(processes):
                process.send_signal(signal.SIGTERM)
                process.wait()
