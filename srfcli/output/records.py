"""A result as a record for programs: CSV by bare column names, and JSON in an envelope."""

from __future__ import annotations

import csv
import io
import json
import math
from typing import Any

from srfcli import __version__
from srfcli.errors import printable
from srfcli.output.tables import Table, plain_value


def to_csv(table: Table) -> str:
    """Return the rows as CSV in full precision; an empty cell stands for nothing, NaN or an infinity."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow([printable(c.name) for c in table.columns])
    for row in table.rows:
        writer.writerow([_csv_cell(v) for v in row])
    return buffer.getvalue()


def _csv_cell(value: Any) -> str:
    if type(value) is float:  # nearly all cells of long records
        return repr(value) if math.isfinite(value) else ""
    simple = plain_value(value)
    if simple is None:
        return ""
    if isinstance(simple, bool):
        return "true" if simple else "false"
    return repr(simple) if isinstance(simple, float) else printable(str(simple))


def json_text(data: Any, *, indent: int | None = None) -> str:
    """Return plain data as JSON that a terminal shows as it is: what it would act on is spelt \\u001b."""
    text = json.dumps(data, indent=indent, ensure_ascii=False, allow_nan=False)
    if printable(text) == text:
        return text
    return "".join(c if c == "\n" or printable(c) == c else json.dumps(c)[1:-1] for c in text)


def envelope(table: Table) -> dict[str, Any]:
    """Return the table as plain data, each row as name -> value, with its schema, parameters and status."""
    names = [c.name for c in table.columns]
    return {
        "schema": table.schema,
        "version": __version__,
        "title": table.title,
        "status": table.status,
        "parameters": plain_value(table.parameters),
        "columns": {c.name: {"unit": c.unit, "about": c.about} for c in table.columns},
        "rows": [dict(zip(names, map(plain_value, row), strict=True)) for row in table.rows],
        "notes": list(table.notes),
        **({"meta": plain_value(table.meta)} if table.meta else {}),
    }


def to_json(table: Table) -> str:
    """Return the envelope as JSON text, one row a line; NaN and infinities are null."""
    data = envelope(table)
    rows = data.pop("rows")
    text = json_text(data, indent=2)
    lines = ",\n".join("    " + json_text(row) for row in rows)
    block = f"[\n{lines}\n  ]" if rows else "[]"
    return f'{text[: text.rindex("}")].rstrip()},\n  "rows": {block}\n}}\n'
