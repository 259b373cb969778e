"""What tests share: drives, buses and machines made for them, and how they judge."""

from pathlib import Path

TESTS = Path(__file__).parents[1]
ROOT = TESTS.parent
INVENTED = TESTS / "invented_drive"  # a device of one's own, outside the package
