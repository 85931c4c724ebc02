"""Routes of the session: sign in, sign out, and invite others."""

from __future__ import annotations

from functools import partial
from typing import Any
from urllib.parse import urlsplit

from twisted.internet.defer import Deferred, gatherResults

from webnode.auth import Token
from webnode.errors import Refusal
from webnode.failover import is_loopback
from webnode.invite import Invites
from webnode.route import API, Content, Field, Route, RouteRequest
from webnode.sanitize import Json
from webnode.session import MAX_SESSION_S, SESSION_S
from webnode.token import MAX_TEXT

INVITATION_S = 86400.0
MAX_INVITATION_S = MAX_SESSION_S


def sign_in(request: RouteRequest) -> Deferred[Json]:
    """Sign in with a code or a password."""
    code, password = request.values["code"], request.values["password"]
    if bool(code) == bool(password):
        problem = "both code and password are given" if code else "the code or password is missing or empty"
        raise Refusal("code", problem, 'send {"code": "..."} or {"password": "..."}')
    return request.services.sessions.sign_in(code or password, request.source, request.now).addCallback(_describe_token)


def read_session(request: RouteRequest) -> Json:
    """Return the name and role of the user."""
    return {"name": request.user.name, "role": request.user.role}


def sign_out(request: RouteRequest) -> Json:
    """End the session."""
    if request.user.token_id:
        # Another web node may have renewed the session just now; that token ends as well.
        until = min(request.user.limit, max(request.user.until, request.now + SESSION_S))
        request.services.sessions.revoke(request.user.token_id, until)
    return {}


def renew_session(request: RouteRequest) -> Json:
    """Return another token for the session."""
    return _describe_token(request.services.sessions.renew_token(request.user, request.now))


def issue_peer_tokens(request: RouteRequest) -> Json:
    """Return tokens with which the page can continue at the team's other web nodes."""
    nodes = [page.node for page in request.services.fallbacks.list_pages() if not page.is_self]
    return {
        node: _describe_token(token)
        for node, token in request.services.sessions.issue_peer_tokens(request.user, nodes, request.now).items()
    }


def invite_guest(request: RouteRequest) -> Any:
    """Return a token for a guest, and the link with which the guest opens the page."""
    values, invites = request.values, request.services.invites
    urls = [] if invites is None else invites.urls()
    if values["page"] and values["page"] not in urls:
        raise Refusal("page", "not a URL of this node's page", f"choose one of {', '.join(urls) or 'none'}")
    token = request.services.sessions.issue_guest_token(
        request.user, values["name"], values["role"], request.now, values["seconds"]
    )
    if invites is None or not urls:
        return _describe_token(token)
    url = values["page"] or urls[0]
    link = f"{url}/#code={token.text}" + ("/phone" if token.role == "phone" else "")
    answer: dict[str, Json] = {
        **_describe_token(token),
        "link": link,
        **_describe_url(url),
        **_describe_authority(invites, urls),
    }
    answer["pages"] = [*urls]
    if not values["draw"]:
        return answer
    qr_codes = gatherResults(
        [invites.draw_qr_code(text) for text in (link, str(answer["certificate"]))], consumeErrors=True
    )
    return qr_codes.addCallback(partial(_add_qr_codes, answer))


def read_authority(request: RouteRequest) -> Content:
    """Return the certificate authority that a browser has to trust; it is public."""
    pem = b"" if request.services.invites is None else request.services.invites.authority
    if not pem:
        raise Refusal("certificate", "the page is not served over TLS", 'set tls = "auto" below [web]', 404)
    return Content(pem, "application/x-x509-ca-cert")


def _add_qr_codes(answer: dict[str, Json], codes: list[str]) -> Json:
    return {**answer, "code": codes[0], "certificate_code": codes[1]}


def _describe_url(url: str) -> dict[str, Json]:
    """Return who can open a page at ``url``, and whether the browser allows it to use the camera."""
    is_here = is_loopback(urlsplit(url).hostname or "")
    return {"is_secure": url.startswith("https:"), "reaches": "machine" if is_here else "network"}


def _describe_authority(invites: Invites, urls: list[str]) -> dict[str, Json]:
    """Return the authority's URL without TLS; over TLS a browser that lacks the authority would show a warning."""
    if not invites.authority:
        return {"certificate": "", "fingerprint": ""}
    plain = next((url for url in urls if url.startswith("http:")), urls[0])
    return {"certificate": f"{plain}{API}/ca.crt", "fingerprint": invites.fingerprint}


def _describe_token(token: Token) -> dict[str, Json]:
    return {"token": token.text, "ticket": token.ticket, "role": token.role, "until": token.until}


ROUTES = (
    Route(
        "POST",
        f"{API}/session",
        "Sign in with the code printed at start (also shown by `swarm web`), an invitation, or the password",
        "anyone",
        sign_in,
        (
            Field("code", "text", "the code, or an invitation's token", maximum=MAX_TEXT, default=""),
            Field("password", "text", "the password", default=""),
        ),
        response="token, ticket, role, until (unix seconds)",
        # Checking a password takes a small device some time.
        limit_s=4.5,
    ),
    Route("GET", f"{API}/session", "The user; anyone if not signed in", "anyone", read_session, response="name, role"),
    Route(
        "PUT",
        f"{API}/session",
        "Renew the session: another token for it; the present token stays valid until its expiry",
        "viewer",
        renew_session,
        response="token, ticket, role, until (unix seconds)",
    ),
    Route(
        "GET",
        f"{API}/session/passes",
        "Tokens for the same session at the team's other web nodes, by uuid: each valid only there, for minutes; "
        "PUT session at that node renews it",
        "viewer",
        issue_peer_tokens,
        response="uuid: token, ticket, role, until (unix seconds)",
    ),
    Route("DELETE", f"{API}/session", "Sign out, at every web node of the team", "anyone", sign_out),
    Route(
        "POST",
        f"{API}/invitations",
        "A token for a guest: as a link for a person, who signs in with it, or for a program, which uses it directly",
        "operator",
        invite_guest,
        (
            Field("role", "choice", "role of the guest", choices=("viewer", "phone", "operator")),
            Field("name", "text", "name of the guest", maximum=40, default="guest"),
            Field(
                "seconds",
                "number",
                "validity",
                minimum=1,
                maximum=MAX_INVITATION_S,
                default=INVITATION_S,
                unit="s",
            ),
            Field("page", "text", "URL of the page, one of this node's", minimum=0, default=""),
            Field("draw", "flag", "also draw QR codes", default=False),
        ),
        response="token, ticket, role, until (unix seconds), link, reaches (network, or this machine), is_secure, "
        "pages, certificate (URL), fingerprint, code (SVG), certificate_code",
    ),
    Route(
        "GET",
        f"{API}/ca.crt",
        "The certificate authority of this node, to be trusted by browsers that open its page over TLS",
        "anyone",
        read_authority,
        response="application/x-x509-ca-cert",
    ),
)
