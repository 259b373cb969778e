"""Saved states: an object's state as plain data that pickles, and how it is put back.

A class names the attributes that make up its state in `STATE`. Each is data (numbers, text, arrays; dicts, lists and
tuples of such), a bundle of arrays, or an object that has a state itself. What follows from how an object was made is
left out: a state is put back into an object that was made alike.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mechanics.kernels.bundle import Bundle

State = dict[str, Any]


class Saved:
    """An object whose state is its attributes named in STATE."""

    STATE: tuple[str, ...] = ()

    def save_state(self) -> State:
        """Return the state, which shares nothing with this object."""
        return {name: _saved(getattr(self, name, None)) for name in self.STATE}

    def restore_state(self, state: State) -> None:
        """Put a state back that an object made alike has saved; it can be restored again and again."""
        for name in self.STATE:
            own = getattr(self, name, None)
            if isinstance(own, Bundle) or hasattr(own, "restore_state"):
                own.restore_state(state[name])  # type: ignore[union-attr]
            else:
                setattr(self, name, _saved(state[name]))


def differences(saved: State, present: State) -> list[str]:
    """Return in which entries two descriptions differ, each as "load is 'gantry' there and 'two_mass' here"."""
    return [
        f"{name} is {_shown(saved.get(name))} there and {_shown(present.get(name))} here"
        for name in dict.fromkeys([*present, *saved])
        if saved.get(name) != present.get(name)
    ]


def check_alike(what: str, saved: State, present: State) -> None:
    """Raise ValueError, naming the difference, unless a state is of an object like the one it shall be put into."""
    if different := differences(saved, present):
        raise ValueError(f"the state is of other {what}: {'; '.join(different)}")


def _shown(value: Any) -> str:
    text = value if isinstance(value, str) else repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _saved(value: Any) -> Any:
    """Return a copy of data, or the state of an object that has one."""
    if isinstance(value, Bundle) or hasattr(value, "save_state"):
        return value.save_state()
    if isinstance(value, np.ndarray):
        return value.copy()
    if isinstance(value, dict):
        return {key: _saved(one) for key, one in value.items()}
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        return type(value)(*map(_saved, value))
    if isinstance(value, (list, tuple)):
        return type(value)(map(_saved, value))
    return value
