"""The exceptions a user can meet. The command line prints their message as one line, exit code 2."""


class AppearanceError(Exception):
    """Base of every error that this package raises on purpose."""


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
