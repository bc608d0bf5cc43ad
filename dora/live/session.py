"""A task that runs in real time in a thread of its own: it steps, carries out orders, and says how it stands."""

from __future__ import annotations

import math
import queue
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch

from dora.arguments import LARGEST_SEED
from dora.errors import InputError
from dora.live.live_task import Beginning, LiveTask
from dora.live.orders import Choose, Order, Play, Push, Randomise, Repeat, Reset, Run, Speed, Start, Step
from dora.live.players import Player
from dora.live.state import LiveState, Poses
from dora.tasks.mdp.randomisation import find_preset

REST = 1.0
"""Time between the end of an episode and the next one [s]."""
SLOWEST, FASTEST = 0.05, 10.0
"""Range of the speed [1]."""
IDLE = 0.2
"""Longest wait for an order [s]; then the thread looks whether it is to end."""
PATIENCE = 30.0
"""Longest wait for the thread to end [s]."""
LATEST = 0.1
"""Backlog above which steps that are due are given up, so that a slow machine runs slowly instead of in bursts [s]."""
SMOOTH = 0.1
"""Share of the newest step in the rate that is told [1]."""
MOST_STEPS = 100_000
"""Largest number of control steps of one order."""


class Session:
    """One environment with somebody who acts in it.

    All work is done by `turn`, in the thread that `start` begins; a test may call `turn` itself instead. `order` may be
    called from any thread, and `state` is a frozen record that may be kept.

    Args:
        env_id: id of the task.
        players: who may act; the first one begins.
        preset: how much episodes are randomised.
        seed: of the first episode; the following ones have the following seeds.
        running: whether time goes on from the beginning.
        clock: gives the time [s].

    Attributes:
        players: by their names.
        clock: gives the time [s].
        state: the newest state.
        error: what ended the thread, if anything did.

    Raises:
        InputError: for an unknown task or preset, no player, or a player whose task cannot be made.
    """

    def __init__(
        self,
        env_id: str,
        players: Sequence[Player],
        *,
        preset: str = "standard",
        seed: int = 0,
        running: bool = True,
        clock: Callable[[], float] = time.monotonic,
    ):
        if not players:
            raise InputError("Somebody has to act: a policy, zero correction or a recording.")
        find_preset(preset)
        self.players = {player.name: player for player in players}
        self.error: BaseException | None = None
        self.clock, self._running, self._speed, self._repeat, self._message = clock, running, 1.0, True, ""
        self._orders: queue.SimpleQueue[Order] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        self._ending = threading.Event()
        self._count = self._episodes = self._successes = self._steps_left = 0
        self._rate, self._last, self._due, self._rest_until = 0.0, None, clock(), 0.0
        self._task = LiveTask(env_id, Beginning(player=players[0], preset=preset, seed=_checked_seed(seed)))
        self._publish()

    # ------------------------------------------------------- from other threads

    def order(self, order: Order) -> None:
        """Have an order carried out between two control steps."""
        self._orders.put(order)

    def start(self) -> None:
        """Begin the thread."""
        self._thread = threading.Thread(target=self._work, name="session", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the thread and close the environment."""
        self._ending.set()
        if self._thread is not None:
            self._thread.join(PATIENCE)
        if self._thread is None or not self._thread.is_alive():
            self._task.close()

    def _work(self) -> None:
        torch.set_num_threads(1)
        try:
            while not self._ending.is_set():
                self.turn(wait=True)
        except BaseException as error:
            self.error = error

    # ------------------------------------------------------------------- a turn

    def turn(self, wait: bool = False) -> bool:
        """Carry out the orders that have come, then do a control step if one is due.

        Args:
            wait: sleep until a step is due or an order comes, `IDLE` at most.

        Returns:
            Whether a control step was done.
        """
        pause = min(max(self._due - self.clock(), 0.0), IDLE) if self._moving else IDLE
        self._obey(pause if wait else 0.0)
        now = self.clock()
        if self._moving and now >= self._due:
            self._step(now)
            return True
        if self._task.over and self._running and self._repeat and now >= self._rest_until:
            self._go_on()
        return False

    @property
    def _moving(self) -> bool:
        """Whether control steps are to be done."""
        return (self._running or self._steps_left > 0) and not self._task.over

    def _step(self, now: float) -> None:
        try:
            self._task.step()
        except InputError as error:  # the action does not fit the task, or is not finite
            self._running, self._steps_left, self._message = False, 0, str(error)
            return self._publish()
        self._steps_left = max(self._steps_left - 1, 0)
        if self._task.over:
            self._steps_left, self._rest_until = 0, now + REST
            self._episodes, self._successes = self._episodes + 1, self._successes + self._task.episode().success
        dt = self._task.setup.dt
        if self._last is not None and now > self._last:
            self._rate += SMOOTH * (dt / (now - self._last) - self._rate)
        self._last, self._due = now, max(self._due + dt / self._speed, now - LATEST)
        self._publish(self._task.passed)

    def _go_on(self) -> None:
        """Begins the next episode. A start that was chosen by hand stays, and so does a candidate."""
        before = self._task.beginning
        try:
            self._begin(replace(before, seed=(before.seed + 1) % (LARGEST_SEED + 1)))
        except InputError as error:
            self._running, self._message = False, str(error)
        self._publish()

    def _begin(self, beginning: Beginning) -> None:
        self._task.begin(beginning)
        self._due, self._last = self.clock(), None

    # ------------------------------------------------------------------- orders

    def _obey(self, pause: float) -> None:
        """Carries out the orders that are there, after waiting for the first one for `pause` [s] at most."""
        try:
            orders = [self._orders.get(timeout=pause) if pause > 0 else self._orders.get_nowait()]
            while not self._orders.empty():
                orders.append(self._orders.get_nowait())
        except queue.Empty:
            return
        starts = [order for order in orders if isinstance(order, Start)]
        for order in orders:
            if not isinstance(order, Start) or order is starts[-1]:  # of a slider that moves only the last place counts
                self._carry_out(order)

    def _carry_out(self, order: Order) -> None:
        self._message = ""
        try:
            HANDLERS[type(order)](self, order)
        except InputError as error:
            self._message = str(error)
        self._publish()

    def _reset(self, order: Reset) -> None:
        before = self._task.beginning
        seed = before.seed if order.seed is None else _checked_seed(order.seed)
        self._begin(replace(before, seed=seed, shares=None))

    def _run(self, order: Run) -> None:
        self._running, self._steps_left, self._rest_until = order.running, 0, 0.0
        self._due, self._last = self.clock(), None

    def _do_steps(self, order: Step) -> None:
        self._running, self._steps_left, self._due = False, min(max(order.count, 0), MOST_STEPS), self.clock()

    def _set_speed(self, order: Speed) -> None:
        if not math.isfinite(order.speed):
            raise InputError(f"The speed is {order.speed}: give a number.")
        self._speed = min(max(order.speed, SLOWEST), FASTEST)
        self._due = self.clock()

    def _set_repeat(self, order: Repeat) -> None:
        self._repeat = order.repeat

    def _play(self, order: Play) -> None:
        if order.player not in self.players:
            raise InputError(f"There is no {order.player!r}; choose one of {', '.join(self.players)}.")
        self._change(player=self.players[order.player], candidate=None, shares=None)

    def _randomise(self, order: Randomise) -> None:
        self._refuse_recording("randomisation")
        find_preset(order.preset)
        self._change(preset=order.preset)

    def _start_at(self, order: Start) -> None:
        self._refuse_recording("start")
        count = len(self._task.setup.numbers)
        if not count or len(order.shares) != count or not all(0 <= share <= 1 for share in order.shares):
            raise InputError(f"A start of this task has {count} numbers, each a share from 0 to 1.")
        self._begin(replace(self._task.beginning, shares=tuple(order.shares)))

    def _choose(self, order: Choose) -> None:
        self._refuse_recording("candidate")
        count = len(self._task.setup.candidates)
        if order.candidate is not None and not 0 <= order.candidate < count:
            raise InputError(f"There is no candidate {order.candidate}; this task has {count} that can be chosen.")
        self._change(candidate=order.candidate)

    def _push(self, order: Push) -> None:
        if not (math.isfinite(order.impulse) and math.isfinite(order.direction)):
            raise InputError(f"The push is {order.impulse} N s towards {order.direction} rad: give finite numbers.")
        self._task.push(order.impulse * math.cos(order.direction), order.impulse * math.sin(order.direction))

    def _refuse_recording(self, what: str) -> None:
        if self._task.beginning.player.recording is not None:
            raise InputError(f"A recording has its own {what}: choose another player first.")

    def _change(self, **changes: Any) -> None:
        """Begins anew with another player, preset or candidate; if that is refused, as before."""
        before = self._task.beginning
        try:
            self._begin(replace(before, **changes))
        except InputError:
            self._begin(before)
            raise
        self._episodes = self._successes = 0

    # -------------------------------------------------------------------- state

    def _publish(self, passed: tuple[Poses, ...] = ()) -> None:
        """Makes the newest state, which came about through these poses."""
        task, self._count = self._task, self._count + 1
        self.state = LiveState(
            count=self._count,
            at=self.clock(),
            passed=passed,
            setup=task.setup,
            **task.reader.poses(),
            scales=task.reader.scales,
            goals=task.reader.goals(),
            forces=task.reader.forces(),
            episode=task.episode(),
            player=task.beginning.player.name,
            preset=task.beginning.preset,
            candidate=task.beginning.candidate,
            running=self._running,
            speed=self._speed,
            rate=self._rate if self._moving else 0.0,
            repeat=self._repeat,
            episodes=self._episodes,
            successes=self._successes,
            message=self._message,
        )


def _checked_seed(seed: int) -> int:
    if not 0 <= seed <= LARGEST_SEED:
        raise InputError(f"The seed is {seed}, and has to be from 0 to {LARGEST_SEED}.")
    return seed


HANDLERS: dict[type, Callable[[Session, Any], None]] = {
    Reset: Session._reset,
    Run: Session._run,
    Step: Session._do_steps,
    Speed: Session._set_speed,
    Repeat: Session._set_repeat,
    Play: Session._play,
    Randomise: Session._randomise,
    Start: Session._start_at,
    Choose: Session._choose,
    Push: Session._push,
}
"""What carries out each order."""
