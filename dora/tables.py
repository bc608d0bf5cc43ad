"""Tables as Markdown, HTML pages and text on a terminal: by jinja2, which escapes what comes from files, and rich."""

from collections.abc import Sequence

import jinja2
from rich.console import Console
from rich.table import Table

_PLAIN, _ESCAPED = jinja2.Environment(), jinja2.Environment(autoescape=True)
_MARKDOWN = _PLAIN.from_string("""\
| {{ head | join(" | ") }} |
|{{ " --- |" * head | length }}
{%- for row in rows %}
| {% for cell in row %}{{ cell | replace("|", "\\\\|") }}{{ " | " if not loop.last }}{% endfor %} |
{%- endfor %}""")


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table, without a line break at its end. Cells are Markdown, but for bars, which are escaped."""
    return _MARKDOWN.render(head=head, rows=rows)


def html_page(template: str, **values: object) -> str:
    """A page from a jinja2 template; values are escaped."""
    return _ESCAPED.from_string(template).render(values)


def print_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table to standard output."""
    table = Table()
    for name in head:
        table.add_column(name, overflow="fold")
    for row in rows:
        table.add_row(*row)
    Console(markup=False).print(table)
