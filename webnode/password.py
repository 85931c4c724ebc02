"""Hash and verify the page's password, and draw a sign-in code for settings without one.

scrypt with N = 2^14, r = 8, p = 5 takes 16 MiB, which a small device has; the OWASP Password Storage Cheat Sheet lists
it as equivalent to N = 2^17, p = 1 with 128 MiB.  It takes some tenths of a second, so it never runs on the reactor's
thread.
"""

from __future__ import annotations

import base64
import hashlib
import hmac
import random

LOG_N, R, P = 14, 8, 5
MEMORY_BYTES = 64 * 1024 * 1024
SALT_BYTES, HASH_BYTES = 16, 32
MIN_LENGTH, MAX_LENGTH = 8, 200
"""Length limits of a password, in characters."""
CODE_LETTERS = "abcdefghjkmnpqrstuvwxyz"
"""Letters of a code; they are easy to tell apart from each other and from digits."""


def draw_code(rng: random.Random) -> str:
    """Draw a sign-in code."""
    letters = "".join(rng.choice(CODE_LETTERS) for _ in range(8))
    return f"{letters[:4]}-{letters[4:]}"


def hash_password(password: str, salt: bytes, log_n: int = LOG_N) -> str:
    """Return the hash for the settings; ``salt`` are 16 random bytes."""
    digest = _scrypt(password, salt, log_n, R, P)
    return "$".join(("scrypt", str(log_n), str(R), str(P), _encode_base64(salt), _encode_base64(digest)))


def verify_password(text: str, password: str) -> bool:
    """Return whether ``text`` is the hash of ``password``; raises ``ValueError`` if it is not a valid hash."""
    log_n, r, p, salt, digest = parse_hash(text)
    return hmac.compare_digest(_scrypt(password, salt, log_n, r, p), digest)


def parse_hash(text: str) -> tuple[int, int, int, bytes, bytes]:
    """Parse a hash; raises ``ValueError`` if it is invalid or needs too much memory."""
    kind, *figures, salt, digest = text.split("$")
    if kind != "scrypt" or len(figures) != 3:
        raise ValueError("the hash does not start with scrypt and three numbers")
    log_n, r, p = (int(figure) for figure in figures)
    if not (1 <= log_n <= 20 and 1 <= r <= 32 and 1 <= p <= 16 and 128 * r * 2**log_n <= MEMORY_BYTES // 2):
        raise ValueError("the numbers of the hash are out of range")
    return log_n, r, p, _decode_base64(salt), _decode_base64(digest)


def _scrypt(password: str, salt: bytes, log_n: int, r: int, p: int) -> bytes:
    return hashlib.scrypt(password.encode(), salt=salt, n=2**log_n, r=r, p=p, maxmem=MEMORY_BYTES, dklen=HASH_BYTES)


def _encode_base64(data: bytes) -> str:
    return base64.urlsafe_b64encode(data).decode().rstrip("=")


def _decode_base64(text: str) -> bytes:
    return base64.b64decode(text.encode("ascii") + b"=" * (-len(text) % 4), b"-_", validate=True)
