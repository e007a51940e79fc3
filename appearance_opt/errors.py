"""The exceptions a user can meet. The command line prints their message as one line, exit code
2."""


def one_line(text: str) -> str:
    """``text`` on one line that is safe to print: control characters, marks that turn the direction
    of writing and lone surrogates, which names in files may hold, become escapes such as
    ``\\x1b``."""
    line = " ".join(text.split())
    return (
        line if line.isprintable() else "".join(c if c.isprintable() else _escape(c) for c in line)
    )


def _escape(character: str) -> str:
    return character.encode("unicode_escape").decode("ascii")


LONGEST = 1000
"""Characters of a message at most: data that is quoted may have any length."""


class AppearanceError(Exception):
    """Base of every error that this package raises on purpose. Its message is one line of printable
    text."""

    def __init__(self, message: str = "") -> None:
        line = one_line(message)
        super().__init__(
            line if len(line) <= LONGEST else f"{line[: LONGEST - 203]} ... {line[-198:]}"
        )


class InputError(AppearanceError):
    """A file or an option is unusable: the message says what, where, and how to mend it."""


class MissingFileError(InputError):
    """A file that an asset refers to is not there."""


class BackendError(AppearanceError):
    """Dr.Jit cannot run here: the message says what to install."""


class ReferenceRenderError(AppearanceError):
    """The reference renderer failed or returned unusable pixels (names the view)."""


class DivergedError(AppearanceError):
    """The fit met repeated non-finite gradients (names parameter and iteration)."""


class BoundError(AppearanceError):
    """A result keeps within its bound less well than was asked for (says by how much)."""
