"""The token of a server: where it comes from, and how long browsers stay signed in."""

from __future__ import annotations

import hmac
import logging
import os
import secrets
import stat
from dataclasses import replace
from pathlib import Path

from annotator.files import make_private, private_folder, read_file
from annotator.types.errors import ConfigError
from annotator.web.security import check_settings, is_loopback
from annotator.web.settings import ServerSettings

LOG = logging.getLogger("annotator.web")

VARIABLE = "ANNOTATOR_TOKEN"
MOST_BYTES = 4096
KEY_BYTES = 32


def with_token(settings: ServerSettings, token_file: Path | None = None, *, no_token: bool = False) -> ServerSettings:
    """Returns the settings with the token of a file, of the variable `ANNOTATOR_TOKEN`, or a new one; and its cookie.

    On a loopback address, browsers stay signed in when the server is started again with a new token: whoever opened the
    link was a user of this computer, to whom the operator had given it. Elsewhere, a new token ends that, as a changed
    one always does. The variable is removed, so that the programs started by this one do not get it.

    Args:
        no_token: everyone who can reach the server may use it; on loopback addresses only.

    Raises:
        ConfigError: the file is unusable, or others may read it; the token is too short; or no token on an address that
            other computers can reach.
    """
    named = os.environ.pop(VARIABLE, None)
    if no_token:
        if token_file is not None:
            raise ConfigError("--token-file and --no-token exclude each other; leave one of them out")
        check_settings(settings)
        return settings
    given = _of_file(token_file) if token_file is not None else named or None
    settings = replace(settings, token=given or secrets.token_urlsafe(32))
    check_settings(settings)
    if given or is_loopback(settings.host):
        return replace(settings, cookie=_cookie(settings.projects_root, given or ""))
    return settings


def _of_file(path: Path) -> str:
    make = f"make one with (umask 077; openssl rand -hex 32 > {path})"
    try:
        # a pipe is welcome: --token-file <(pass show annotator)
        with path.open("rb") as file:
            if os.name != "nt" and stat.S_IMODE(os.fstat(file.fileno()).st_mode) & 0o077:
                raise ConfigError(f"--token-file {path}: other users may read it; run chmod 600 {path}")
            content = file.read(MOST_BYTES + 1)
    except OSError as error:
        raise ConfigError(f"--token-file {path}: cannot be read ({error.strerror}); {make}") from error
    text = content.decode("utf-8", "replace").strip()
    if len(content) > MOST_BYTES or not text or len(text.split()) > 1:
        raise ConfigError(f"--token-file {path}: is not one line with a token; {make}")
    return text


def _cookie(projects_root: Path, token: str) -> str:
    """The cookie of a token, the same after each start; another one for other projects, users and computers."""
    return hmac.new(_key(), f"{projects_root.resolve()}\n{token}".encode(), "sha256").hexdigest()


def _key() -> bytes:
    """The secret of this user on this computer. It is not in the projects folder, which people copy and send."""
    path = state_folder() / "secret"
    try:
        private_folder(path.parent)
        make_private(path)
        key = read_file(path, MOST_BYTES)
        if len(key) != KEY_BYTES:
            key = secrets.token_bytes(KEY_BYTES)
            path.write_bytes(key)
        return key
    except OSError as error:
        LOG.warning("%s: cannot be kept (%s); browsers must open the link again after a restart", path, error)
        return secrets.token_bytes(KEY_BYTES)


def state_folder() -> Path:
    """The folder for what annotator remembers about this user on this computer."""
    place = os.environ.get("XDG_STATE_HOME") or os.environ.get("LOCALAPPDATA")
    return (Path(place) if place else Path.home() / ".local" / "state") / "annotator"
