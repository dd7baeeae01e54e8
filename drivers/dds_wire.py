"""DDS wires to a real network, by Eclipse Cyclone DDS (extra ``[dds]``), with payloads passed through as bytes.

The Python binding builds and takes apart a sample field by field, at 0.2 to 0.5 ms for a LowCmd or a LowState; here its
types only tell DDS what they are called and made of, and the bytes are the codecs'.

A G1 has no watchdog that could be programmed, and what its motors do when LowCmd stops is undocumented. On any interface
but loopback a bus is therefore refused until its wiring says ``watchdog: 0``, by which a person accepts that.
"""

# An extra: absent where nobody asked for it.
# pyright: reportMissingImports=false

from __future__ import annotations

from functools import cache
from typing import Any
from xml.sax.saxutils import quoteattr

from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
from cyclonedds.core import DDSException, InstanceState, Policy, Qos
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import make_idl_struct
from cyclonedds.idl.annotations import autoid, final
from cyclonedds.idl.types import array, float32, int16, int32, int64, sequence, uint8, uint32
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

from drivers.bus import BusSpec, ImuSpec
from drivers.codecs import unitree_api as api
from drivers.codecs import unitree_hg as hg
from drivers.dds_bus import StateStream
from drivers.wire import WireError

LOOPBACK = "lo"
DEPTH = 16  # samples kept until they are read
ENDPOINTS = 1000  # of other programs, looked at


def _type(name: str, **fields: Any) -> Any:
    """A type as unitree_sdk2 declares it: DDS compares names, members and kinds before two programs may talk."""
    package = "unitree_api" if name.startswith("Re") else "unitree_hg"
    return autoid("sequential")(final(make_idl_struct(name, f"{package}.msg.dds_.{name}", fields)))


MotorCmd = _type(
    "MotorCmd_", mode=uint8, q=float32, dq=float32, tau=float32, kp=float32, kd=float32, reserve=uint32
)  # fmt: skip
ImuState = _type(
    "IMUState_", quaternion=array[float32, 4], gyroscope=array[float32, 3], accelerometer=array[float32, 3],
    rpy=array[float32, 3], temperature=int16,
)  # fmt: skip
MotorState = _type(
    "MotorState_", mode=uint8, q=float32, dq=float32, ddq=float32, tau_est=float32, temperature=array[int16, 2],
    vol=float32, sensor=array[uint32, 2], motorstate=uint32, reserve=array[uint32, 4],
)  # fmt: skip
LowCmd = _type(
    "LowCmd_", mode_pr=uint8, mode_machine=uint8, motor_cmd=array[MotorCmd, hg.SLOTS], reserve=array[uint32, 4], crc=uint32
)  # fmt: skip
LowState = _type(
    "LowState_", version=array[uint32, 2], mode_pr=uint8, mode_machine=uint8, tick=uint32, imu_state=ImuState,
    motor_state=array[MotorState, hg.SLOTS], wireless_remote=array[uint8, 40], reserve=array[uint32, 4], crc=uint32,
)  # fmt: skip
RequestIdentity = _type("RequestIdentity_", id=int64, api_id=int64)
RequestLease = _type("RequestLease_", id=int64)
RequestPolicy = _type("RequestPolicy_", priority=int32, noreply=bool)
RequestHeader = _type("RequestHeader_", identity=RequestIdentity, lease=RequestLease, policy=RequestPolicy)
Request = _type("Request_", header=RequestHeader, parameter=str, binary=sequence[uint8])
ResponseStatus = _type("ResponseStatus_", code=int32)
ResponseHeader = _type("ResponseHeader_", identity=RequestIdentity, status=ResponseStatus)
Response = _type("Response_", header=ResponseHeader, data=str, binary=sequence[uint8])

TYPES: dict[str, Any] = {
    hg.COMMAND_TOPIC: LowCmd,
    hg.STATE_TOPIC: LowState,
    api.MOTION_REQUEST: Request,
    api.MOTION_RESPONSE: Response,
}


class Payload:
    """A sample that is its own CDR payload, for the binding to hand through."""

    def __init__(self, payload: bytes) -> None:
        self.payload = payload

    def serialize(self, *_: Any, **__: Any) -> bytes:
        return self.payload

    @classmethod
    def deserialize(cls, data: bytes, *_: Any, **__: Any) -> Payload:
        return cls(data)

    deserialize_key = deserialize


@cache
def carrier(topic: str) -> type[Any]:
    """The type of ``topic`` as DDS sees it, with Payload's bytes in place of its members. Raises WireError."""
    if topic not in TYPES:
        raise WireError(f"DDS topic '{topic}': its type is not known here; expected one of {', '.join(TYPES)}")
    type_ = TYPES[topic]
    return type(type_.__name__, (Payload,), {"__idl__": type_.__idl__})


@cache
def _configure(interface: str, domain: int) -> Domain:
    """The domain of this process on that interface; kept for good, for a domain cannot be configured twice.

    On loopback without multicast, which it may not have: participants look for each other on the first ports.
    """
    loopback = (
        "<Discovery><ParticipantIndex>auto</ParticipantIndex><Peers><Peer address='127.0.0.1'/></Peers></Discovery>"
        if interface == LOOPBACK
        else ""
    )
    multicast = "<AllowMulticast>false</AllowMulticast>" if interface == LOOPBACK else ""
    return Domain(
        domain,
        f"<CycloneDDS><Domain><General><Interfaces><NetworkInterface name={quoteattr(interface)}/></Interfaces>{multicast}"
        f"</General>{loopback}</Domain></CycloneDDS>",
    )


class CycloneWire:
    """A drivers.wire.DdsWire. Writers and readers are made when a topic is first used, except those asked for here."""

    def __init__(
        self, interface: str, domain: int = 0, reads: tuple[str, ...] = (), writes: tuple[str, ...] = ()
    ) -> None:
        """Raises WireError if there is no such interface."""
        self._where = f"DDS domain {domain} on {interface}"
        try:
            _configure(interface, domain)
            self._participant = DomainParticipant(domain)
            self._endpoints = BuiltinDataReader(self._participant, BuiltinTopicDcpsPublication)
        except DDSException as error:
            raise WireError(
                f"{self._where}: {error.msg}\n  Is there such an interface, and is it up? (`ip link`)"
            ) from None
        self._open = True
        self._topics: dict[str, Topic] = {}
        self._readers: dict[str, DataReader] = {}
        self._writers: dict[str, DataWriter] = {}
        for topic in reads:
            self._reader(topic)
        for topic in writes:
            self._writer(topic)

    def write(self, topic: str, payload: bytes) -> None:
        self._check()
        try:
            self._writer(topic).write(carrier(topic)(payload))
        except DDSException as error:
            raise WireError(f"{self._where}: {topic}: {error.msg}") from None

    def read(self, topic: str) -> list[bytes]:
        self._check()
        try:
            samples = self._reader(topic).take(N=DEPTH)
        except DDSException as error:
            raise WireError(f"{self._where}: {topic}: {error.msg}") from None
        return [s.payload for s in samples if isinstance(s, Payload)]

    def writers(self, topic: str) -> int:
        """Other participants' writers, this program's other wires included."""
        self._check()
        alive = InstanceState.Alive
        return sum(
            bool(e.sample_info.instance_state & alive)
            and e.topic_name == topic
            and e.participant_key != self._participant.guid
            for e in self._endpoints.read(N=ENDPOINTS)
        )

    def close(self) -> None:
        if not self._open:
            return
        self._open = False
        # The binding frees an entity when nothing refers to it any more.
        self._readers.clear()
        self._writers.clear()
        self._topics.clear()
        del self._endpoints, self._participant

    def _check(self) -> None:
        if not self._open:
            raise WireError(f"{self._where}: used after close; open the wire again")

    def _topic(self, name: str) -> Topic:
        if name not in self._topics:
            self._topics[name] = Topic(self._participant, name, carrier(name))
        return self._topics[name]

    def _reader(self, topic: str) -> DataReader:
        if topic not in self._readers:
            qos = Qos(Policy.History.KeepLast(DEPTH))
            self._readers[topic] = DataReader(self._participant, self._topic(topic), qos)
        return self._readers[topic]

    def _writer(self, topic: str) -> DataWriter:
        if topic not in self._writers:
            self._writers[topic] = DataWriter(self._participant, self._topic(topic))
        return self._writers[topic]


def open_dds(spec: BusSpec | ImuSpec) -> CycloneWire | StateStream:
    """The wire of ``spec.channel``: a network interface and, after a colon, a domain other than 0 (``lo:1``).

    Raises WireError; for a bus on a real network also until its ``watchdog`` is 0 (see above).
    """
    interface, _, domain = spec.channel.partition(":")
    if not interface or not (domain or "0").isdecimal():
        raise WireError(
            f"got channel '{spec.channel}', expected a network interface, as in eth0 or lo:1 (DDS domain 1)"
        )
    number = int(domain or 0)
    if isinstance(spec, ImuSpec):
        return StateStream(CycloneWire(interface, number, reads=(hg.STATE_TOPIC,)))
    if interface != LOOPBACK and spec.watchdog:
        raise WireError(
            f"got watchdog {spec.watchdog:g} s, but the motors of a G1 have none that could be programmed, and what they "
            "do when commands stop is undocumented\n  Hang the robot up, keep its remote and its power switch at hand, and say "
            "'watchdog: 0' in the wiring to accept that"
        )
    return CycloneWire(interface, number, (hg.STATE_TOPIC, api.MOTION_RESPONSE), (hg.COMMAND_TOPIC, api.MOTION_REQUEST))
