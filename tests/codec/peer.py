"""CPython's side of the comparison. Reads one request per line, and prints one answer per line.

    call HEX    how rosmaster understands a request: `ok METHOD VALUES`, or `raise WHY`
    reply HEX   how a Python client understands an answer: `ok VALUE`, `fault CODE TEXT`, `raise WHY`
    fault HEX   the text of the fault that a server answers to a request
    echo HEX    the answer, in hex, of a server whose method `echo` returns its parameter
    dumps HEX   the same request, in hex, as a Python client writes it
"""
import decimal
import struct
import sys
import xmlrpc.client
import xmlrpc.server

import defusedxml.xmlrpc

defusedxml.xmlrpc.monkey_patch()


def text(value):
    """A value in the same notation as on the Rust side. Without recursion, because values are deep."""
    out, todo = [], [value]
    while todo:
        v = todo.pop()
        if isinstance(v, Mark):
            out.append(v.text)
        elif v is None:
            out.append("nil")
        elif type(v) is bool:
            out.append("bool:%d" % v)
        elif type(v) is int:
            out.append("int:%d" % v)
        elif type(v) is decimal.Decimal:
            out.append("decimal:%s" % v)
        elif type(v) is float:
            bits = b"nan" if v != v else struct.pack(">d", v).hex().encode()
            out.append("double:" + bits.decode())
        elif type(v) is str:
            out.append("string:" + v.encode().hex())
        elif type(v) is xmlrpc.client.DateTime:
            out.append("date:" + v.value.encode().hex())
        elif type(v) is xmlrpc.client.Binary:
            out.append("base64:" + v.data.hex())
        elif type(v) in (list, tuple):
            out.append("[")
            todo.append(Mark("]"))
            todo.extend(reversed(v))
        elif type(v) is dict:
            out.append("{")
            todo.append(Mark("}"))
            for key, member in reversed(v.items()):
                todo.extend((member, key))
        else:
            out.append("other:%s" % type(v).__name__)
    return " ".join(out)


class Mark:
    def __init__(self, text):
        self.text = text


def call(body):
    values, method = xmlrpc.client.loads(body)
    if method is None:
        return "raise no method"
    return "ok %s %s" % (text(method), text(values))


def reply(body):
    try:
        values, _ = xmlrpc.client.loads(body)
    except xmlrpc.client.Fault as fault:
        return "fault %s %s" % (text(fault.faultCode), text(fault.faultString))
    # What ServerProxy hands out is the single value.
    return "ok " + text(values[0]) if len(values) == 1 else "raise not one value"


server = xmlrpc.server.SimpleXMLRPCDispatcher()
server.register_function(lambda value: value, "echo")


def fault(body):
    try:
        xmlrpc.client.loads(server._marshaled_dispatch(body))
    except xmlrpc.client.Fault as fault:
        return fault.faultString
    return "no fault"


def echo(body):
    return server._marshaled_dispatch(body).hex()


def dumps(body):
    values, method = xmlrpc.client.loads(body)
    # As ServerProxy calls it.
    return xmlrpc.client.dumps(values, method, encoding="utf-8").encode().hex()


for line in sys.stdin:
    verb, _, document = line.strip().partition(" ")
    try:
        answer = {"call": call, "reply": reply, "fault": fault, "echo": echo, "dumps": dumps}[verb](bytes.fromhex(document))
    except Exception as error:
        answer = "raise %s %r" % (type(error).__name__, str(error)[:100])
    print(answer, flush=True)
