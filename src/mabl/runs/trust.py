"""Which run folders may name code. One that this user's mabl wrote may; a stranger's may not.

An environment of one's own is named `adapter:module:factory`, in `config.yaml` too: whoever loads
the run imports the module and calls the factory. So what mabl writes there is signed with a key of
the user's, and what is not signed so must be trusted explicitly.
"""

import hmac
import os
import secrets
from hashlib import sha256
from pathlib import Path

SIGNATURE = "config.signature"


def sign(folder: Path) -> None:
    """Say that this user's mabl wrote the config of a run folder. Without a home, it cannot."""
    key = user_key(create=True)
    if key:
        (folder / SIGNATURE).write_text(signature(folder, key))


def is_own(folder: Path) -> bool:
    """Whether this user's mabl wrote the config as it is."""
    key, file = user_key(), folder / SIGNATURE
    if key is None or not file.is_file() or file.is_symlink():
        return False
    with file.open("rb") as opened:
        return hmac.compare_digest(opened.read(100), signature(folder, key).encode())


def signature(folder: Path, key: bytes) -> str:
    """Of the config's bytes."""
    return hmac.new(key, (folder / "config.yaml").read_bytes(), sha256).hexdigest()


def user_key(create: bool = False) -> bytes | None:
    """The user's secret, made when it is first needed; None where there can be none."""
    try:
        home = Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config")
        path = home / "mabl" / "key"
        if create and not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            with os.fdopen(
                os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb"
            ) as file:
                file.write(secrets.token_bytes(32))
        return path.read_bytes() or None
    except (OSError, RuntimeError):
        return None
