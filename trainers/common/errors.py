"""Mistakes of the user's, as opposed to failures of the program."""


class UserError(Exception):
    """The user's mistake: the message names it and the way out, and no traceback is shown."""
