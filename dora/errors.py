"""The exception that Dora raises for input that a person can correct."""


class InputError(ValueError):
    """Bad input: the message is one sentence that says what is wrong and how to mend it.

    Scripts print it without a traceback and end with exit status 2.
    """
