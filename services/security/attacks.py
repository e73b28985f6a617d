"""Attacks on a secured installation, one function per subject; each yields the attempts and their results."""

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any, Literal

import zenoh

from services.security.authority import Authority, Identity, encoded
from services.security.check_sessions import PAUSE, PAYLOAD, CheckSessions, Listener, answer, answered, until
from services.security.init import CA, CA_KEY
from services.security.plan import InstallationPlan
from services.wire.roles import RATES, SIZES

Verdict = Literal["refused", "NOT REFUSED", "works", "DOES NOT WORK", "not tried"]
REPEATS = 5
"""Every attack is repeated this often, because one message may be lost by chance."""
FLOOD = 0.5
"""A flood lasts this long [s]."""
LISTENS = 0.3
"""After the permitted receivers got a message, the check waits this long [s] for other receivers."""
FORGED = b"gemuco security check, forged"


@dataclass(frozen=True, slots=True)
class Attempt:
    """An attempt and its result."""

    what: str
    verdict: Verdict
    text: str = ""


def refused(what: str, is_refused: bool, text: str = "") -> Attempt:
    """Return the result of an attack."""
    return Attempt(what, "refused" if is_refused else "NOT REFUSED", text)


def allowed(what: str, works: bool, text: str = "") -> Attempt:
    """Return the result of a permitted use; a refusal proves nothing unless permitted uses work."""
    return Attempt(what, "works" if works else "DOES NOT WORK", text)


def people(plan: InstallationPlan) -> tuple[str, str, str]:
    """Return the names of an operator and a viewer of the attacked robot, and the robot's name."""
    robot = next(iter(plan.robots))
    named = {person.role: name for name, person in reversed(plan.people.items()) if {"*", robot} & set(person.robots)}
    return named.get("operator", ""), named.get("viewer", ""), robot


def entering(sessions: CheckSessions, name: str, where: str = "", at: str = "the router") -> Iterator[Attempt]:
    """Try to connect without one part of what a connection needs."""
    sessions.member(name, where)
    yield allowed(f"{name} connects to {at}", True)

    def tried(what: str, change: Callable[[dict[str, Any], dict[str, Any], dict[str, Any]], None]) -> Attempt:
        configured = sessions.outside(name, where)
        change(configured, configured["transport"]["link"]["tls"], configured["transport"]["auth"]["usrpwd"])
        return refused(f"{what} at {at}", not sessions.enters(configured))

    yield tried("clear text", _clear_text)
    yield tried("no certificate", _no_certificate)
    stranger = Authority.new()
    yield tried("certificate of a foreign authority", lambda _, tls, __: _as(tls, _signed(stranger, name)))
    key = sessions.folder / CA_KEY
    if key.exists():
        ours = Authority(Identity((sessions.folder / CA).read_bytes(), key.read_bytes()))
        ended = _signed(ours, name, timedelta(hours=-1))
        yield tried("expired certificate", lambda _, tls, __: _as(tls, ended))
    else:
        yield Attempt(f"expired certificate at {at}", "not tried", f"{CA_KEY} is not here to sign one")
    yield tried("wrong password", lambda _, __, login: login.update(password="wrong"))
    yield tried("unknown user", lambda _, __, login: login.update(user="stranger"))
    yield tried("no password", lambda configured, _, __: configured["transport"].pop("auth"))


def at_the_hal(sessions: CheckSessions, operator: str, viewer: str) -> Iterator[Attempt]:
    """Try to use the robot's direct links without being one of its services."""
    yield from entering(sessions, f"model.{sessions.robot}", sessions.hal, "the HAL")
    for name in (operator, viewer):
        yield refused(f"{name} past the router, at the HAL", not sessions.enters(sessions.outside(name, sessions.hal)))
    heard = Listener(sessions.hal_session, sessions.key("hal", "command"))
    recorder = sessions.member(f"recorder.{sessions.robot}", sessions.hal)
    model = sessions.member(f"model.{sessions.robot}", sessions.hal)
    for _ in range(REPEATS):
        recorder.put(sessions.key("hal", "command"), FORGED)
        time.sleep(PAUSE)
    works = until(lambda: model.put(sessions.key("hal", "command"), PAYLOAD) is None and heard.count(PAYLOAD))
    yield allowed("model commands at the HAL", works)
    yield refused("recorder commands at the HAL", not heard.count(FORGED))


class Inside:
    """Attacks by members that were accepted."""

    def __init__(self, sessions: CheckSessions, operator: str, viewer: str) -> None:
        self.sessions = sessions
        self.command, self.target = sessions.key("hal", "command"), sessions.key("model", "target")
        self.operator, self.viewer = sessions.member(operator), sessions.member(viewer)
        self.names = operator, viewer
        self.recorder = sessions.member(f"recorder.{sessions.robot}")
        self.hal = sessions.member(f"hal.{sessions.robot}")
        self.heard, self.seen = (
            Listener(self.recorder, sessions.key("**")),
            Listener(self.viewer, sessions.key("hal", "status")),
        )
        self._number = 0

    def run(self) -> Iterator[Attempt]:
        """Make all attacks."""
        yield from self.allowed()
        yield from self.publishing()
        yield from self.foreign_password()
        yield from self.spying()
        yield from self.querying()
        yield from self.answering()
        yield from self.robots()
        yield from self.limits()

    def allowed(self) -> Iterator[Attempt]:
        """Check permitted uses; unless they work, a refusal proves nothing."""
        sessions = self.sessions
        yield allowed("operator commands", self.settled())
        status = sessions.key("hal", "status")
        works = until(lambda: self.hal.put(status, PAYLOAD) is None and self.seen.count(PAYLOAD))
        yield allowed("viewer looks on", works)
        if sessions.is_running:
            return
        describe = sessions.key("hal", "do", "describe")
        yield allowed("operator asks the HAL", until(lambda: answered(self.operator, describe)))
        yield allowed("viewer asks who the HAL is", until(lambda: answered(self.viewer, describe)))
        yield allowed("viewer sees who is alive", until(lambda: "model" in self._alive(self.viewer)))

    def settled(self) -> bool:
        """Whether a new message of the operator arrives; all earlier accepted messages have then arrived too."""
        self._number += 1
        mark = PAYLOAD + str(self._number).encode()
        return until(lambda: self.operator.put(self.command, mark) is None and self.heard.count(mark))

    def publishing(self) -> Iterator[Attempt]:
        """Publish as a viewer, which has no right to publish."""
        sessions, forged = self.sessions, (("hal", "sample"), ("model", "estimate"), ("vision", "sample"))
        attacks = {
            "viewer commands": self.command,
            "viewer sets a target": self.target,
            "viewer puts on wildcards": sessions.key("hal", "*"),
            "viewer puts on every key": "gemuco/**",
            **{f"viewer forges {service}/{noun}": sessions.key(service, noun) for service, noun in forged},
        }
        before = self.heard.count(b"")
        yield from self._published(self.viewer, attacks, lambda: self.viewer.delete(self.command))
        yield refused("viewer deletes", self.heard.count(b"") == before)

    def _published(
        self, session: zenoh.Session, attacks: Mapping[str, str], also: Callable[[], object] = lambda: None
    ) -> Iterator[Attempt]:
        """Put on keys; each attack has its own payload, which identifies the attack on any key."""
        marks = {what: FORGED + what.encode() for what in attacks}
        for _ in range(REPEATS):
            for what, key in attacks.items():
                session.put(key, marks[what])
            also()
            time.sleep(PAUSE)
        if not self.settled():
            yield allowed("operator is heard meanwhile", False)
        for what, mark in marks.items():
            yield refused(what, not self.heard.count(mark))

    def foreign_password(self) -> Iterator[Attempt]:
        """Connect with a certificate and a password of two members, which must give no rights."""
        operator, viewer = self.names
        configured = self.sessions.outside(viewer, self.sessions.door_of(operator))
        configured["transport"]["auth"] = self.sessions.outside(operator)["transport"]["auth"]
        what = "viewer's certificate with the operator's password"
        try:
            mixed = self.sessions.open(configured)
        except zenoh.ZError:
            yield refused(what, True, "the connection was refused")
            return
        listener = Listener(mixed, self.sessions.key("hal", "status"))
        yield from self._published(mixed, {f"{what}: commands": self.command})
        yield refused(f"{what}: looks on", not self._shown(listener))

    def _shown(self, *listeners: Listener) -> bool:
        """Whether a listener hears a status that the viewer hears."""
        self._number += 1
        mark, key = PAYLOAD + str(self._number).encode(), self.sessions.key("hal", "status")
        until(lambda: self.hal.put(key, mark) is None and self.seen.count(mark))
        return until(lambda: any(listener.count(mark) for listener in listeners), LISTENS)

    def spying(self) -> Iterator[Attempt]:
        """Subscribe to commands, which only the robot may receive."""
        name, patterns = self.names[1], ("**", "gemuco/**", self.sessions.key("**"), self.command)
        spies = {pattern: Listener(self.sessions.member(name), pattern) for pattern in patterns}
        if not (self.settled() and self.settled()):
            yield allowed("operator is heard meanwhile", False)
        until(lambda: all(spy.anything for spy in spies.values()), LISTENS)
        for pattern, spy in spies.items():
            yield refused(f"viewer spies on {pattern}", not spy.anything)

    def querying(self) -> Iterator[Attempt]:
        """Query verbs that change something as a viewer, and query the router's admin space."""
        sessions, asked = self.sessions, []
        if not sessions.is_running:
            for service, verb in (("hal", "enable"), ("model", "engage")):
                session = sessions.hal_session if service == "hal" else sessions.model_session
                key = sessions.key(service, "do", verb)
                asked.append(answer(session, key, b"done"))
                works = until(lambda key=key: answered(self.operator, key, b"done"))  # type: ignore[misc]
                yield allowed(f"operator asks {service}/do/{verb}", works)
                for selector in (key, "gemuco/**"):
                    yield refused(f"viewer asks {selector}", not answered(self.viewer, selector, b"done"))
        for name, session in zip(self.names, (self.operator, self.viewer), strict=True):
            replies = [str(r.ok.key_expr) for r in session.get("@/**", timeout=1.0) if r.ok is not None]
            # A session may read its own admin space.
            foreign = [key for key in replies if str(session.zid()) not in key.split("/")[1]]
            yield refused(f"{name} reads the router's admin space", not foreign)

    def answering(self) -> Iterator[Attempt]:
        """Answer and declare liveliness in the place of a service."""
        fake = self.sessions.key("model", "do", "estimate")
        queryable = answer(self.viewer, fake, FORGED)
        token = self.viewer.liveliness().declare_token(self.sessions.key("vision", "alive"))
        self.settled()
        is_fooled = any(answered(self.operator, fake, FORGED) for _ in range(REPEATS))
        yield refused("viewer answers in the model's place", not is_fooled)
        yield refused("viewer pretends that the camera is alive", "vision" not in self._alive(self.operator))
        queryable.undeclare()
        token.undeclare()

    def robots(self) -> Iterator[Attempt]:
        """Publish as a service of another robot."""
        sessions = self.sessions
        other = next((name for name in sessions.plan.robots if name != sessions.robot), "")
        if not other:
            yield Attempt("HAL of one robot forges another's", "not tried", "the plan has one robot only")
            return
        listener, theirs = (
            Listener(sessions.member(f"recorder.{other}"), f"gemuco/{other}/**"),
            sessions.member(f"hal.{other}"),
        )
        nouns = ("hal/sample", "model/estimate", "hal/command")
        for _ in range(REPEATS):
            for noun in nouns:
                self.hal.put(f"gemuco/{other}/{noun}", FORGED + noun.encode())
            time.sleep(PAUSE)
        key = f"gemuco/{other}/hal/status"
        yield allowed(
            f"hal.{other} is heard", until(lambda: theirs.put(key, PAYLOAD) is None and listener.count(PAYLOAD))
        )
        for noun in nouns:
            is_heard = listener.count(FORGED + noun.encode())
            yield refused(f"hal.{sessions.robot} forges {noun} of '{other}'", not is_heard)
        yield from self._published(
            self.hal, {f"hal.{sessions.robot} forges model/estimate": sessions.key("model", "estimate")}
        )

    def limits(self) -> Iterator[Attempt]:
        """Exceed the limits of size and rate as an operator."""
        most = SIZES["hal/command"]
        yield allowed(f"operator sends {most} bytes", self._passes(b"s" * most))
        for _ in range(REPEATS):
            self.operator.put(self.command, b"l" * (most + 1))
        if not self.settled():
            yield allowed("operator is heard meanwhile", False)
        yield refused(f"operator sends {most + 1} bytes", not self.heard.count(b"l" * (most + 1)))
        sent, begun, flood = 0, time.monotonic(), PAYLOAD + b" flood"
        while (lasted := time.monotonic() - begun) < FLOOD:
            self.operator.put(self.target, flood)
            sent += 1
        self.settled()
        heard, most_heard = self.heard.count(flood, self.target), 1.5 * RATES["model/target"] * lasted
        text = f"{sent} sent in {lasted:.1f} s, {heard} passed"
        if sent < 2 * most_heard:
            yield Attempt("operator floods", "not tried", f"{text}: this machine is too slow")
        else:
            yield refused("operator floods", heard <= most_heard, text)

    def _passes(self, payload: bytes) -> bool:
        return until(lambda: self.operator.put(self.command, payload) is None and self.heard.count(payload))

    def _alive(self, session: zenoh.Session) -> set[str]:
        replies = session.liveliness().get(self.sessions.key("*", "alive"), timeout=2.0)
        return {str(reply.ok.key_expr).split("/")[2] for reply in replies if reply.ok is not None}


def impostor(sessions: CheckSessions, name: str) -> Attempt:
    """Check that a client does not send its password to a router of a foreign authority."""
    stranger, fake = Authority.new(), sessions.of("router")
    fake["listen"]["endpoints"] = [where := sessions.another_endpoint()]
    tls = fake["transport"]["link"]["tls"]
    _as(tls, _signed(stranger, "router", hosts=("127.0.0.1",)))
    tls |= {"root_ca_certificate_base64": encoded(stranger.identity.certificate), "enable_mtls": False}
    sessions.open(fake)
    return refused("a router of a foreign authority", not sessions.enters(sessions.outside(name, where)))


def _clear_text(configured: dict[str, Any], tls: dict[str, Any], login: dict[str, Any]) -> None:
    endpoints = [f"tcp/{endpoint.partition('/')[2]}" for endpoint in configured["connect"]["endpoints"]]
    configured["connect"] = configured["connect"] | {"endpoints": endpoints}
    configured["transport"]["link"]["protocols"] = ["tcp"]


def _no_certificate(configured: dict[str, Any], tls: dict[str, Any], login: dict[str, Any]) -> None:
    for part in ("connect_certificate_base64", "connect_private_key_base64", "enable_mtls"):
        tls.pop(part)


def _signed(by: Authority, name: str, for_: timedelta = timedelta(days=1), hosts: tuple[str, ...] = ()) -> Identity:
    return by.sign(name, hosts, datetime.now(UTC) + for_)


def _as(tls: dict[str, Any], identity: Identity) -> None:
    certificate, key = encoded(identity.certificate), encoded(identity.key)
    for kind in ("connect", "listen"):
        tls |= {f"{kind}_certificate_base64": certificate, f"{kind}_private_key_base64": key}
