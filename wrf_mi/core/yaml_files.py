"""YAML of others, bounded: aliases cannot make a small file a large value."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from .errors import DataFault
from .files import one_line, text_lines

MOST_NODES = 1_000_000
"""Most values of a document with its aliases written out: five million for nine levels of nine aliases each."""


class _Loader(yaml.SafeLoader):
    """Names the line of a value that looks like a date or a number and is none, and counts what aliases repeat."""

    def get_single_node(self) -> yaml.Node | None:
        node = super().get_single_node()
        if node is not None:
            self._written_out(node, {})
        return node

    def _written_out(self, node: yaml.Node, counts: dict[int, int]) -> int:
        """Number of nodes at and below a node, those of aliases each time."""
        if (count := counts.get(id(node))) is not None:
            if not count:
                raise yaml.constructor.ConstructorError(None, None, "an alias of what holds it", node.start_mark)
            return count
        counts[id(node)], count = 0, 1  # open until it is counted
        if isinstance(node, yaml.SequenceNode):
            count += sum(self._written_out(each, counts) for each in node.value)
        elif isinstance(node, yaml.MappingNode):
            count += sum(self._written_out(each, counts) for pair in node.value for each in pair)
        if count > MOST_NODES:
            text = f"more than {MOST_NODES} values with its aliases written out"
            raise yaml.constructor.ConstructorError(None, None, text, node.start_mark)
        counts[id(node)] = count
        return count

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        try:
            value = super().construct_object(node, deep)
            if isinstance(value, int):
                float(value)  # hundreds of digits are no quantity, and no array takes them
        except (yaml.YAMLError, RecursionError):
            raise
        except Exception as error:  # PyYAML's constructors raise a dozen kinds
            text = f"no {node.tag.rpartition(':')[2]} ({one_line(error)})"
            raise yaml.constructor.ConstructorError(None, None, text, node.start_mark) from None
        return value


def read_yaml(path: Path) -> dict[Any, Any]:
    """The mapping of a YAML file; empty where it holds anything else.

    `InputError`: missing, not text, not YAML, with an impossible date or number, or too large with its aliases.
    """
    text = "\n".join(text_lines(path))
    try:
        content = yaml.load(text, Loader=_Loader)
    except (yaml.YAMLError, RecursionError) as error:
        raise DataFault(path, f"not YAML ({one_line(error)}); correct it") from None
    return content if isinstance(content, dict) else {}
