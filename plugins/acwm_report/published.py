"""What a report says about the published figures beside a run's own."""

from __future__ import annotations

from acwm_core.evaluation.benchmark import published_tables
from acwm_core.evaluation.results import Summary


def about_published(summary: Summary) -> str:
    """Where the published figures of a run come from and how far they are comparable, as text."""
    if not summary.published:
        return ""
    row, same = summary.published.row, summary.published.same_parts
    setting = ", ".join(str(row.setting[name]) for name in ("model", "codec", "conditioner"))
    facts = [f"published: {row.citation}, {row.label} ({setting})"]
    if not same:
        facts.append("this run has other components")
    table = published_tables().get(row.table)  # none where its plugin is not installed
    if table and summary.protocol != table.protocol:
        facts.append(f"measured on other clips: compare with --protocol {table.protocol}")
    return "; ".join(facts) + (f". {row.note}" if row.note else "")
