"""YAML without tags, aliases and merges: what is read is no larger than its text."""

from typing import Any

import yaml


class PlainLoader(yaml.SafeLoader):
    """Refuses aliases, by which a few lines can stand for gigabytes."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        """A node, if it is no alias."""
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("aliases are not read")
        return super().compose_node(parent, index)


def load(text: str) -> Any:
    """Plain data. Raises ValueError for text that is no such YAML."""
    try:
        return yaml.load(text, PlainLoader)
    except Exception as error:  # its constructors raise whatever they meet
        raise ValueError(str(error).partition("\n")[0][:200]) from error
