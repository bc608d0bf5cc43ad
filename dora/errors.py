"""The one exception that Dora raises for input a person can mend."""


class InputError(ValueError):
    """Bad input: the message is one sentence that says what is wrong and how to mend it.

    Scripts print it without a traceback and end with exit status 2.
    """
