"""Tables as Markdown, HTML pages and text on a terminal, and shares of trials with their intervals.

Jinja2 escapes what comes from files; rich draws on terminals.
"""

import html
import io
from collections.abc import Sequence

import jinja2
from markupsafe import Markup, escape
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

MARKS = "\\`*_{}[]~$"
"""Characters within a line that Markdown may read as marks; bars are escaped by tables."""
CONFIDENCE = 0.95
"""Probability with which an interval covers the true share [1]."""
_PLAIN, _ESCAPED = jinja2.Environment(), jinja2.Environment(autoescape=True)
"""Templates of text, and of pages in which values are escaped."""
_MARKDOWN = _PLAIN.from_string("""\
| {{ head | join(" | ") }} |
|{{ " --- |" * head | length }}
{%- for row in rows %}
| {% for cell in row %}{{ cell | replace("|", "\\\\|") }}{{ " | " if not loop.last }}{% endfor %} |
{%- endfor %}""")
"""A Markdown table."""


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table, without a line break at its end. Cells are Markdown, but for bars, which are escaped."""
    return _MARKDOWN.render(head=head, rows=rows)


def markdown_text(text: str) -> str:
    """A text from a file as Markdown that shows it: HTML, marks and line breaks are escaped."""
    plain = html.escape(" ".join(text.split()), quote=False)
    return "".join(f"\\{c}" if c in MARKS else c for c in plain)


def with_code(text: str) -> Markup:
    """A text as HTML, escaped, in which what stands between two backticks is shown as code."""
    pieces = [escape(piece) for piece in text.split("`")]
    if len(pieces) % 2 == 0:
        return escape(text)
    return Markup("").join(Markup("<code>%s</code>") % piece if i % 2 else piece for i, piece in enumerate(pieces))


def html_page(template: str, **values: object) -> str:
    """A page from a jinja2 template, which may call `with_code`; values are escaped."""
    return _ESCAPED.from_string(template).render(values, with_code=with_code)


def print_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table to standard output."""
    Console(markup=False).print(_table(head, rows, Table()))


def text_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table as plain text, as wide as its content, without a line break at its end."""
    console = Console(markup=False, width=10_000, file=io.StringIO(), color_system=None)
    with console.capture() as captured:
        console.print(_table(head, rows, Table(box=SIMPLE_HEAD, show_edge=False, pad_edge=False)))
    return "\n".join(line.rstrip() for line in captured.get().splitlines()).strip("\n")


def _table(head: Sequence[str], rows: Sequence[Sequence[str]], table: Table) -> Table:
    for name in head:
        table.add_column(name, overflow="fold")
    for row in rows:
        table.add_row(*row)
    return table


def wilson(hits: int, trials: int) -> tuple[float, float]:
    """Wilson's interval of a share `hits` / `trials` (E. B. Wilson 1927); (0, 1) without trials."""
    from scipy.stats import binomtest  # half a second, for commands that print no share

    if trials == 0:
        return 0.0, 1.0
    interval = binomtest(hits, trials).proportion_ci(CONFIDENCE, "wilson")
    return float(interval.low), float(interval.high)


def share_text(share: float, trials: int, scale: float = 1.0, digits: int = 3) -> str:
    """A share with its interval, such as "0.875 [0.822, 0.914]"; `scale` 100 gives percent."""
    low, high = wilson(round(share * trials), trials)
    return f"{scale * share:.{digits}f} [{scale * low:.{digits}f}, {scale * high:.{digits}f}]"
