"""A table of rows as one test: thousands of rows that take no time are no thousands of tests."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable
from typing import Any

import pytest

Check = Callable[..., None]


def every_row(names: str | tuple[str, ...], rows: Iterable[Any]) -> Callable[[Check], Check]:
    """As `pytest.mark.parametrize`, but in one test, which fails with each row that is wrong. No table is empty.

    Rows share the test's fixtures: for checks that leave behind what they have found.
    """
    words, table = (names,) if isinstance(names, str) else names, list(rows)

    def decorated(check: Check) -> Check:
        def test(**fixtures: Any) -> None:
            assert table, "no rows"
            wrong = []
            for row in table:
                values = dict(zip(words, (row,) if isinstance(names, str) else row, strict=True))
                try:
                    check(**fixtures, **values)
                except (Exception, pytest.fail.Exception) as error:
                    wrong.append(f"{values}: {type(error).__name__}: {error}")
            if wrong:
                pytest.fail(f"{len(wrong)} of {len(table)} rows are wrong:\n" + "\n".join(wrong), pytrace=False)

        given = inspect.signature(check)
        left = [one for name, one in given.parameters.items() if name not in words]
        test.__signature__ = given.replace(parameters=left)
        test.__name__, test.__doc__, test.__module__ = check.__name__, check.__doc__, check.__module__
        return test

    return decorated
