"""Many runs by one command that can be interrupted: which, which of them are finished, where they are trained."""
