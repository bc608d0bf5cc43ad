"""DoraHammer-v1: catch a falling hammer, bring it over a nail, and drive the nail in."""

from dora.tasks.hammer.task import HammerTask as HammerTask
