"""Exchange among the processes of one machine, through memory that all of them have mapped.

The memory has no name: it is handed on through sockets (`man 7 unix`, SCM_RIGHTS), and is gone with
the last process, however that ends. By the sockets they wait for each other, too: who waits takes
no core from the others, and who dies is noticed at once, as the system closes what was open.
"""

from __future__ import annotations

import mmap
import os
import pickle
import socket
import struct
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from trainers.common.timers import timed

PAGE_BYTES = 4096
NUMBER = struct.Struct("q")
HANDED_ON = b"memory"


def is_possible() -> bool:
    """Whether torchrun started all processes on this machine, which is one that can do so."""
    own, all_machines = os.environ.get("LOCAL_WORLD_SIZE"), os.environ.get("WORLD_SIZE")
    return own == all_machines and hasattr(os, "memfd_create")  # Linux has it


def connected_sockets(
    rank: int, size: int, first: Callable[[bytes], bytes], timeout_s: float
) -> list[socket.socket]:
    """Sockets to everyone else of the first of k processes; to that one of the others.

    Args:
        rank: number of this process, from 0.
        size: k.
        first: tells everyone what the first one gives.
        timeout_s: of whatever is sent and received.
    """

    def made() -> socket.socket:
        return socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)

    if rank:
        peers = [made()]
        peers[0].connect(first(b""))
    else:
        with made() as listener:
            listener.bind("")  # to a name that the system chooses, and that is no file
            listener.listen(size)
            first(listener.getsockname())
            peers = [listener.accept()[0] for _ in range(size - 1)]
    for peer in peers:
        peer.settimeout(timeout_s)
    return peers


class SharedMemory:
    """A place in memory for each of k processes, and one for what they come to together.

    All processes call the same methods in the same order.

    Args:
        rank: number of this process, from 0.
        size: k.
        peers: see `connected_sockets`.
    """

    def __init__(self, rank: int, size: int, peers: Sequence[socket.socket]):
        self._rank, self._size, self._peers = rank, size, peers
        self._places = torch.empty(size + 1, 0, dtype=torch.uint8)

    def sum(self, values: Tensor) -> Tensor:
        """Sums (n,) of everyone's, in place: added by rank, so that they are alike everywhere.

        Each process adds up a part of them.

        Raises:
            OSError: one of the others is gone, or has not come in time.
        """
        count = values.numel()
        self._make_room(values.nbytes)
        *places, total = self._places[:, : values.nbytes].view(values.dtype)
        places[self._rank].copy_(values)
        self._wait()
        part = slice(self._rank * count // self._size, (self._rank + 1) * count // self._size)
        torch.add(places[0][part], places[1][part], out=total[part])
        for place in places[2:]:
            total[part] += place[part]
        self._wait()
        return values.copy_(total)

    def gather(self, value: Any) -> list[Any]:
        """Everyone's values, by rank.

        Raises:
            OSError: one of the others is gone, or has not come in time.
        """
        content = pickle.dumps(value, pickle.HIGHEST_PROTOCOL)
        self._make_room(self._largest(len(content)))
        places = [place.numpy() for place in self._places]
        places[self._rank][: len(content)] = np.frombuffer(content, np.uint8)
        self._wait()
        # What is behind a value in its place is not read.
        values = [pickle.loads(place) for place in places[: self._size]]
        self._wait()
        return values

    def close(self) -> None:
        """Lets the others notice that this process exchanges nothing any more."""
        for peer in self._peers:
            peer.close()

    def _make_room(self, length: int) -> None:
        """Gives each a place of so many bytes at least, if they are smaller."""
        if length <= self._places.shape[1]:
            return
        length = -(-length // PAGE_BYTES) * PAGE_BYTES
        if self._rank == 0:
            file = os.memfd_create("ventosa")
            os.truncate(file, (self._size + 1) * length)
            for peer in self._peers:
                socket.send_fds(peer, [HANDED_ON], [file])
        else:
            content, files, *_ = socket.recv_fds(self._peers[0], len(HANDED_ON), 1)
            _check(content)
            (file,) = files
        memory = mmap.mmap(file, 0)
        os.close(file)
        self._places = torch.frombuffer(memory, dtype=torch.uint8).view(self._size + 1, length)

    def _wait(self) -> None:
        """Returns once everyone has come here."""
        self._largest(0)

    def _largest(self, number: int) -> int:
        """The largest of everyone's numbers."""
        with timed("wait"):
            if self._rank:
                self._peers[0].send(NUMBER.pack(number))
                return _received(self._peers[0])
            largest = max(number, *map(_received, self._peers))
            for peer in self._peers:
                peer.send(NUMBER.pack(largest))
            return largest


def _received(peer: socket.socket) -> int:
    """A number from another process; OSError as in `SharedMemory.sum`."""
    number: int = NUMBER.unpack(_check(peer.recv(NUMBER.size)))[0]
    return number


def _check(content: bytes) -> bytes:
    if not content:
        raise ConnectionResetError("another process closed its connection")
    return content
