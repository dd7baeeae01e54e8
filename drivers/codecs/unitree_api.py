"""Unitree's request and response messages (`unitree_api`), and the service that owns the robot's own controllers.

A service NAME listens on ``rt/api/NAME/request`` and answers on ``rt/api/NAME/response`` with the request's id. CDR:

    request   id i64, api i64, lease i64, priority i32, noreply bool, parameter string, binary sequence of bytes
    response  id i64, api i64, code i32, data string, binary sequence of bytes

Source: unitree_sdk2_python (IDL of unitree_api, motion_switcher_api).
"""

from __future__ import annotations

import struct
from typing import NamedTuple

from drivers.codecs.unitree_hg import CDR_HEADER

MOTION_REQUEST, MOTION_RESPONSE = "rt/api/motion_switcher/request", "rt/api/motion_switcher/response"
CHECK_MODE, RELEASE_MODE = 1001, 1003  # answered with {"form": ..., "name": the controller in charge, "": none}

_REQUEST = struct.Struct("<qqqi?3x")
_RESPONSE = struct.Struct("<qqi")


class Request(NamedTuple):
    """What is asked of a service. ``parameter``: JSON."""

    id: int
    api: int
    parameter: str = "{}"


class Response(NamedTuple):
    """What a service answers. ``code`` 0: done. ``data``: JSON."""

    id: int
    api: int
    code: int
    data: str = ""


def pack_request(request: Request) -> bytes:
    """CDR payload of a request that wants an answer."""
    return CDR_HEADER + _tail(_REQUEST.pack(request.id, request.api, 0, 0, False), request.parameter)


def pack_response(response: Response) -> bytes:
    """CDR payload of an answer."""
    return CDR_HEADER + _tail(_RESPONSE.pack(response.id, response.api, response.code), response.data)


def unpack_request(payload: bytes) -> Request | None:
    """The request in a CDR payload; None if it is none."""
    text = _text(payload, _REQUEST.size)
    if text is None:
        return None
    id, number, *_ = _REQUEST.unpack_from(payload, len(CDR_HEADER))
    return Request(id, number, text)


def unpack_response(payload: bytes) -> Response | None:
    """The response in a CDR payload; None if it is none."""
    text = _text(payload, _RESPONSE.size)
    if text is None:
        return None
    id, number, code = _RESPONSE.unpack_from(payload, len(CDR_HEADER))
    return Response(id, number, code, text)


def _tail(head: bytes, text: str) -> bytes:
    """``head``, a string with its length and final zero, and an empty sequence."""
    data = text.encode() + b"\0"
    body = head + struct.pack("<I", len(data)) + data
    return body + b"\0" * (-len(body) % 4) + struct.pack("<I", 0)


def _text(payload: bytes, head: int) -> str | None:
    """The string behind a head of so many bytes."""
    at = len(CDR_HEADER) + head
    if len(payload) < at + 4 or payload[:2] != CDR_HEADER[:2]:
        return None
    (length,) = struct.unpack_from("<I", payload, at)
    data = payload[at + 4 : at + 4 + length]
    if len(data) != length or not data.endswith(b"\0"):
        return None
    return data[:-1].decode(errors="replace")
