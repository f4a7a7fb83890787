"""What tests run their subject with: programs, terminals, costs."""

from pathlib import Path

PROJECT = Path(__file__).parents[2]
