"""Values that begin with a minus: `drive-env set 60FF -1000` is the number, since no option begins with a digit."""

from __future__ import annotations

import re
from typing import Any

from typer.core import TyperCommand

_NEGATIVE = re.compile(r"-\.?\d")


class SignedValues(TyperCommand):
    """A command that parses an argument like a negative number as a value, also before `--`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Read the command line; a space in front hides the minus from the parser."""
        end = args.index("--") if "--" in args else len(args)
        hidden = [f" {one}" if _NEGATIVE.match(one) else one for one in args[:end]] + args[end:]
        left = super().parse_args(ctx, hidden)
        for name, value in ctx.params.items():
            if isinstance(value, str) and _NEGATIVE.match(value[1:]):
                ctx.params[name] = value.removeprefix(" ")
        return left
