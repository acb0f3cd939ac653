"""``python -m igsr.cli``."""

from __future__ import annotations

from igsr.cli import main

main()
