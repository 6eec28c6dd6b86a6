"""Who may talk to rnd-view: whoever brings the token, once in the page's URL and then in a cookie.

A loopback address is reachable by every user of the machine, so it asks for the token too. Requests there must also
name that address as their host (against DNS rebinding). A page of another origin is refused everywhere.
"""

from __future__ import annotations

import hmac
import ipaddress
from dataclasses import dataclass
from http import HTTPStatus
from typing import Any
from urllib.parse import parse_qs, urlsplit

HTTP_PORT = 80  # which browsers leave out of the host's name


def is_loopback(host: str) -> bool:
    """Whether nobody but this machine can reach ``host``."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


@dataclass(frozen=True)
class Access:
    """Who may talk to the server.

    Attributes:
        token: what every request must bring.
        cookie: name of the cookie that keeps it. Browsers share cookies among ports, so each port has its own.
        hosts: names by which a browser on this machine may call it; None for any.
    """

    token: str
    cookie: str
    hosts: frozenset[str] | None

    @classmethod
    def of(cls, host: str, port: int, token: str) -> Access:
        """For the address ``host`` and its port."""
        names = {"localhost", "127.0.0.1", "[::1]", f"[{host}]" if ":" in host else host}
        called = {f"{name}:{port}" for name in names}
        hosts = frozenset(called | names if port == HTTP_PORT else called)
        return cls(token, f"rnd_view_token_{port}", hosts if is_loopback(host) else None)

    def refusal(self, path: str, headers: Any) -> tuple[HTTPStatus, str] | None:
        """Why a request is not answered, or None if it is."""
        try:
            return self._refusal(path, headers)
        except (ValueError, LookupError):  # an address that is none, a header that is there twice
            return HTTPStatus.BAD_REQUEST, "not a request that rnd-view understands\n"

    def set_cookie(self) -> str:
        """Value of the header that gives a browser the token."""
        return f"{self.cookie}={self.token}; Path=/; HttpOnly; SameSite=Strict"

    def _refusal(self, path: str, headers: Any) -> tuple[HTTPStatus, str] | None:
        query = urlsplit(path).query
        host, origin = headers.get("Host", "").lower(), headers.get("Origin")
        if self.hosts is not None and host not in self.hosts:
            return HTTPStatus.FORBIDDEN, "rnd-view answers to this machine's own address only\n"
        if origin is not None and urlsplit(origin).netloc.lower() != host:
            return HTTPStatus.FORBIDDEN, "another site's page may not use rnd-view\n"
        if not self._has_token(query, headers):
            return HTTPStatus.UNAUTHORIZED, "open the address that rnd-view printed, token included\n"
        return None

    def _has_token(self, query: str, headers: Any) -> bool:
        # By hand: Python's own parser stops at the first cookie, of whatever other program, that it does not like.
        cookies = (cookie.strip().partition("=") for cookie in headers.get("Cookie", "").split(";"))
        given = parse_qs(query).get("token", []) + [value for name, _, value in cookies if name == self.cookie]
        return any(hmac.compare_digest(text.encode(), self.token.encode()) for text in given)
