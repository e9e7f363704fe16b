"""Which run folders may name code. One that this user's mabl wrote may; a stranger's may not.

An environment of one's own is named `adapter:module:factory`, in `config.yaml` too: whoever loads
the run imports the module and calls the factory. So mabl signs what it writes there, in its last
line, with a key of the user's; what is not signed so must be trusted explicitly.
"""

import hmac
import os
import secrets
from contextlib import suppress
from hashlib import sha256
from pathlib import Path

MARK = "# signed "


def signed(text: str) -> str:
    """A config with the user's signature; as it is where the user has no place for a key."""
    key = user_key(create=True)
    return f"{text}{MARK}{signature(text, key)}\n" if key else text


def is_own(text: str) -> bool:
    """Whether this user's mabl wrote that config as it is."""
    body, _, given = text.rpartition(MARK)
    key = user_key()
    return key is not None and hmac.compare_digest(f"{signature(body, key)}\n", given)


def signature(text: str, key: bytes) -> str:
    """Of a text, by a key."""
    return hmac.new(key, text.encode(), sha256).hexdigest()


def user_key(create: bool = False) -> bytes | None:
    """The user's secret, made when it is first needed; None where there can be none."""
    try:
        home = Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config")
        path = home / "mabl" / "key"
        if create and not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            draft = path.with_name(f"key-{secrets.token_hex(8)}")
            draft.touch(0o600)
            draft.write_bytes(secrets.token_bytes(32))
            with suppress(FileExistsError):  # another process was first
                os.link(draft, path)
            draft.unlink()
        return path.read_bytes() or None
    except (OSError, RuntimeError):
        return None
