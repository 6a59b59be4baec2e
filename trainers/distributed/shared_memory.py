"""Exchange among the processes of one machine, through memory that all of them have mapped.

The memory has no name: it is handed on through sockets (`man 7 unix`, SCM_RIGHTS), and is gone with
the last process, however that ends. By the sockets they wait for each other, too: who waits takes
no core from the others, and who dies is noticed at once, as the system closes what was open.
"""

from __future__ import annotations

import math
import mmap
import os
import pickle
import socket
import struct
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
import torch
from torch import Tensor

from trainers.common.timers import timed

PAGE_BYTES = 4096
KEPT_BYTES = 2**28
"""Of places for later exchanges: those of a checkpoint with replay buffers are given back."""
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
            listener.settimeout(timeout_s)
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
        self._pool = torch.empty(0, dtype=torch.uint8)

    def sum(self, parts: Sequence[Tensor], weight: float) -> Tensor:
        """Sums of everyone's values: added by rank, so that they are alike everywhere.

        Each process adds up as many of them.

        Args:
            parts: vectors of one kind, n numbers in all.
            weight: of one's own.

        Returns:
            (n,) of its own.

        Raises:
            OSError: one of the others is gone, or has not come in time.
        """
        length = sum(part.nbytes for part in parts)
        self._make_room(length)
        *places, total = self._places[:, :length].view(parts[0].dtype)
        torch.cat([*parts], out=places[self._rank]).mul_(weight)
        self._wait()
        ends = [rank * len(total) // self._size for rank in (self._rank, self._rank + 1)]
        first, second, *others = (place[slice(*ends)] for place in places)
        own = torch.add(first, second, out=total[slice(*ends)])
        for other in others:
            own += other
        self._wait()
        return total.clone()

    def gather(self, value: Any, *, to_first: bool = False) -> list[Any]:
        """Everyone's values, by rank.

        Args:
            value: one's own.
            to_first: the first process alone has them; others have nothing.

        Raises:
            OSError: one of the others is gone, or has not come in time.
        """
        content = pickle.dumps(value, pickle.HIGHEST_PROTOCOL)
        self._make_room(self._largest(len(content)))
        places = [place.numpy() for place in self._places]
        places[self._rank][: len(content)] = np.frombuffer(content, np.uint8)
        self._wait()
        # What is behind a value in its place is not read.
        unread = to_first and self._rank > 0
        values = [] if unread else [pickle.loads(place) for place in places[: self._size]]
        self._wait()
        if self._places.nbytes > KEPT_BYTES:
            self._places = torch.empty(self._size + 1, 0, dtype=torch.uint8)
        return values

    def pool(self, tensors: Sequence[Tensor]) -> list[Tensor]:
        """Everyone's (sum of n, ...), by rank: views of the memory, valid until the next call.

        Args:
            tensors: (n, ...) one's own; alike everywhere but for n.

        Raises:
            OSError: one of the others is gone, or has not come in time.
        """
        lengths = torch.tensor(self.gather([len(own) for own in tensors]))
        firsts, totals = lengths[: self._rank].sum(0).tolist(), lengths.sum(0).tolist()
        row_bytes = [own.element_size() * math.prod(own.shape[1:]) for own in tensors]
        rooms = [_whole_pages(total * row) for total, row in zip(totals, row_bytes, strict=True)]
        if sum(rooms) > len(self._pool):
            self._pool = self._map(sum(rooms))
        wholes = []
        for own, first, total, room in zip(
            tensors, firsts, totals, self._pool[: sum(rooms)].split(rooms), strict=True
        ):
            count = total * math.prod(own.shape[1:])
            whole = room.view(own.dtype)[:count].view(total, *own.shape[1:])
            whole[first : first + len(own)] = own
            wholes.append(whole)
        self._wait()
        return wholes

    def close(self) -> None:
        """Lets the others notice that this process exchanges nothing any more."""
        for peer in self._peers:
            # An environment's process may have got the socket, too, and keep it open.
            with suppress(OSError):
                peer.shutdown(socket.SHUT_RDWR)
            peer.close()

    def _make_room(self, length: int) -> None:
        """Gives each a place of so many bytes at least, if they are smaller."""
        if length > self._places.shape[1]:
            length = _whole_pages(length)
            self._places = self._map((self._size + 1) * length).view(self._size + 1, length)

    def _map(self, length: int) -> Tensor:
        """New memory of so many bytes, the same for all."""
        if self._rank == 0:
            file = os.memfd_create("ventosa")
            os.truncate(file, length)
            for peer in self._peers:
                socket.send_fds(peer, [HANDED_ON], [file])
        else:
            content, files, *_ = socket.recv_fds(self._peers[0], len(HANDED_ON), 1)
            _check(content)
            (file,) = files
        memory = mmap.mmap(file, 0)
        os.close(file)
        return torch.frombuffer(memory, dtype=torch.uint8)

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


def _whole_pages(length: int) -> int:
    """The bytes of the pages that so many take."""
    return -(-length // PAGE_BYTES) * PAGE_BYTES


def _received(peer: socket.socket) -> int:
    """A number from another process; OSError as in `SharedMemory.sum`."""
    number: int = NUMBER.unpack(_check(peer.recv(NUMBER.size)))[0]
    return number


def _check(content: bytes) -> bytes:
    if not content:
        raise ConnectionResetError("another process closed its connection")
    return content
