"""Why some mutants live: they change nothing that can be seen, or a constant that was tuned."""

from __future__ import annotations

from typing import Final

REASONS: Final[dict[tuple[str, str], str]] = {}
"""By module and change, as ``docs/results/mutants.md`` shows them."""
