#!/usr/bin/python3
"""A cable that delays and loses packets, since not every kernel has netem: copies Ethernet frames between two devices.

    bad_network.py DEVICE DEVICE DELAY_MS JITTER_MS LOSS_PERCENT SEED
"""

import heapq
import random
import select
import socket
import sys
import time

ETH_P_ALL = 3
# linux/if_packet.h: each frame begins with the header that says whether its checksum is still to be made, and where it
# is to be cut. The kernel hands both on.
SOL_PACKET, PACKET_VNET_HDR = 263, 15
HEADER = 10
FRAME = 1 << 17


def open_device(name):
    device = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(ETH_P_ALL))
    device.setsockopt(SOL_PACKET, PACKET_VNET_HDR, 1)
    device.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
    device.bind((name, ETH_P_ALL))
    device.setblocking(False)
    return device


def main():
    names, (delay, jitter, loss), seed = sys.argv[1:3], map(float, sys.argv[3:6]), sys.argv[6]
    chance = random.Random(int(seed))
    devices = [open_device(name) for name in names]
    other = {devices[0]: devices[1], devices[1]: devices[0]}
    # When, in which order, to where, and what. TCP takes frames that overtake each other for a loss: each way keeps its order.
    waiting, number, latest = [], 0, {device: 0.0 for device in devices}
    print("ready", flush=True)
    while True:
        limit = max(0.0, waiting[0][0] - time.monotonic()) if waiting else None
        for device in select.select(devices, [], [], limit)[0]:
            frame, source = device.recvfrom(FRAME)
            if source[2] == socket.PACKET_OUTGOING or len(frame) <= HEADER or chance.random() * 100 < loss:
                continue
            due = time.monotonic() + (delay + chance.random() * jitter) / 1e3
            due = latest[device] = max(due, latest[device])
            number += 1
            heapq.heappush(waiting, (due, number, other[device], frame))
        while waiting and waiting[0][0] <= time.monotonic():
            _, _, to, frame = heapq.heappop(waiting)
            try:
                to.send(frame)
            except OSError:
                # A device that is down, or whose queue is full, loses it.
                pass


if __name__ == "__main__":
    main()
