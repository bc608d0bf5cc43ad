"""The exceptions that Dora raises for what a person can correct, and for runs that cannot go on."""

RECORDS = "DORA_NONFINITE"
"""Environment variable with the folder for the last states of simulations that were not finite."""


class InputError(ValueError):
    """Bad input: the message is one sentence that says what is wrong and how to mend it.

    Scripts print it without a traceback and end with exit status 2.
    """


class RunFailure(RuntimeError):
    """A run cannot go on, but can be resumed: the message is one sentence that says why.

    Scripts print it without a traceback, with the command that resumes, and end with exit status 1.
    """


class WorkerFailure(RunFailure):
    """A worker process died, hangs, or raised something; this process is well."""
