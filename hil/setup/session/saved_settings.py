"""The settings of an arm's servos: saved before the first write, restored, and verified once all are restored."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

from hil.drivers.bus import ServoBus
from hil.drivers.errors import DriverError, WrongModel, WrongSetting
from hil.drivers.joint import Joint
from hil.drivers.preparation.settings import PROTECTIVE, cut_goals, put_back, read_settings, unlike
from hil.drivers.servo import Servo
from hil.drivers.torque.held import Originals
from hil.errors import RunFolderError
from hil.setup.session import settings_file
from hil.setup.session.killed_run import Left, is_left_on, left_behind, what_is_left
from hil.setup.session.settings_file import Kept

_REST_S = 0.05
"""Delay between finding that settings differ and restoring them again [s]."""

_MOST_CHECKS = 3
"""Maximum number of times that the settings of all servos are read again after being restored."""


@dataclass
class SavedSettings:
    """The settings to restore. Each servo has a file on disk until its settings have been restored.

    say: receives messages for the user. config: absolute path of the arm's configuration, recorded in the files.
    """

    bus: ServoBus
    _say: Callable[[str], None]
    config: str = ""
    left: dict[Joint, Kept] = field(default_factory=dict)
    """Settings that an earlier run saved but did not restore, by servo."""
    kept: dict[Joint, Kept] = field(default_factory=dict)
    """Saved settings of the servos whose settings this session changes."""
    wanted: dict[Joint, dict[str, int]] = field(default_factory=dict)
    """Settings to restore: the saved ones, but with the present values of registers that another program has changed
    since a run was killed.
    """
    reduced: dict[Joint, dict[str, int]] = field(default_factory=dict)
    """Goals that could be restored only as far as a lowered limit allows, with the values that they now have."""
    undone: dict[tuple[Joint, str], tuple[int, int]] = field(default_factory=dict)
    """Registers that another program had changed, each with that program's value and the restored value."""
    _refused: set[Joint] = field(default_factory=set)
    """Servos whose Current Limit another program has left too low for this run; the file keeps its former value."""

    def look_for_left(self) -> None:
        """Find the settings that an earlier run on this port did not restore. Raises DamagedSettings."""
        url = self.bus.port.url
        self.left = {joint: kept for joint in self.bus.drives if (kept := left_behind(url, joint)) is not None}

    def left_on(self) -> list[Joint]:
        """Servos whose torque an earlier run on this port left on. Raises the errors of `Servo.read`."""
        return [joint for joint, kept in self.left.items() if is_left_on(self.bus.drives[joint], kept)]

    def save(self, joint: Joint, settings: dict[str, int], changed: dict[str, int]) -> None:
        """Write a servo's settings to disk. changed: the EEPROM registers that this session will set.

        Raises DriverError.
        """
        if joint in self.left:
            self._take_over(joint, what_is_left(self.left[joint], self.bus.drives[joint], settings), changed)
        else:
            self._keep(joint, settings, changed)

    def _take_over(self, joint: Joint, left: Left, changed: dict[str, int]) -> None:
        """Save the settings that an earlier run left, and report which of them will be restored.

        A value that another program has set counts as the servo's own from now on, unless it prevents this run.
        """
        if said := left.told(joint.title):
            self._say(said)
        if left.is_refused(changed):
            self._refused.add(joint)
            self._keep(joint, left.kept.settings, changed, left.kept.since)
            self.wanted[joint] = left.wanted
        else:
            self._keep(joint, left.wanted, changed)

    def save_held(self, joints: Iterable[Joint]) -> Originals:
        """Save to disk the settings of servos that are about to be let down, and return these settings.

        If an earlier program began to let them down, its file holds the original goals. Raises the errors of
        `Servo.read`.
        """
        for joint in joints:
            servo = self.bus.drives[joint]
            settings, since = read_settings(servo), ""
            changed = {name: settings[name] for name in ("Operating Mode", *PROTECTIVE) if name in settings}
            if joint in self.left:
                left = what_is_left(self.left[joint], servo, settings)
                settings, changed, since = left.wanted, {**left.kept.changed, **left.changed}, left.kept.since
            self.left[joint] = self._on_file(joint, settings, changed, since, was_held=True)
        return {joint: self.left[joint].settings for joint in joints}

    def _keep(self, joint: Joint, settings: dict[str, int], changed: dict[str, int], since: str = "") -> None:
        self.wanted[joint] = settings
        self.kept[joint] = self._on_file(joint, settings, changed, since)

    def _on_file(
        self, joint: Joint, settings: dict[str, int], changed: dict[str, int], since: str, *, was_held: bool = False
    ) -> Kept:
        """Write a servo's file. If that fails, report the values that this program is about to change."""
        url, model = self.bus.port.url, joint.servo.name
        try:
            return settings_file.keep(url, joint.id, model, settings, changed, since, self.config, was_held=was_held)
        except RunFolderError as error:
            ours = ("Goal PWM", "Goal Current") if was_held else ("Operating Mode", "Current Limit")
            values = ", ".join(f"{name} {settings[name]}" for name in ours if name in settings)
            copy = "" if was_held else f" For all settings, see {settings_file.COPY_NAME} in the run folder."
            self._say(
                f"The settings of {joint} cannot be saved where the next run would find them: {error} If this program "
                f"is killed, set them again by hand: {values}.{copy}"
            )
            return Kept(url, joint.id, model, settings, changed, 0, "", was_held=was_held)

    def put_back(self, joints: Iterable[Joint]) -> dict[Joint, DriverError]:
        """Restore the settings of these joints; return the error of each joint that failed."""
        failed: dict[Joint, DriverError] = {}
        for joint in joints:
            try:
                self.bus.confirm_later(joint)
                servo, settings = self.bus.drives[joint], self.wanted[joint]
                self._check_model(servo)
                written = put_back(servo, settings)
                self._note_foreign(joint, written)
                self.reduced[joint] = cut_goals(servo, settings)
            except DriverError as error:
                failed[joint] = error
        return failed

    def _note_foreign(self, joint: Joint, written: Mapping[str, tuple[int, int]]) -> None:
        """Remember the registers that held neither this session's value nor the restored one."""
        ours = self.kept[joint].changed
        for name, (found, restored) in written.items():
            if name in ours and found != ours[name]:
                self.undone[joint, name] = found, restored

    def verify(self, failed: dict[Joint, DriverError]) -> None:
        """Read the settings of all servos again once the last one has been restored, and restore those that differ.

        Replies that belong to earlier requests, or IDs that are swapped in between, can make a servo that was never
        reached seem restored. failed: receives the errors of the servos whose settings still differ.
        """
        for attempt in range(_MOST_CHECKS):
            differing = {
                joint: error
                for joint in self.kept
                if joint not in failed and (error := self._differs(joint)) is not None
            }
            if not differing:
                return
            clock = self.bus.port.clock
            clock.wait_until(clock.now() + _REST_S)  # for late replies, or another program's occasional writes
            failed |= self.put_back(differing) if attempt < _MOST_CHECKS - 1 else differing

    def forget(self, restored: Iterable[Joint]) -> None:
        """Remove the files of these servos, except where a goal or limit has yet to be restored."""
        for joint in restored:
            if joint in self._refused or (self.reduced[joint] and joint not in self.left):
                continue
            if left := settings_file.forget(self.kept[joint]):
                self._say(left)

    def _differs(self, joint: Joint) -> DriverError | None:
        """Return the error for a servo whose settings cannot be read or do not read back as restored, or None."""
        try:
            found = unlike(self.bus.drives[joint], self.wanted[joint])
        except DriverError as error:
            return error
        if found is None:
            return None
        name, now, wanted = found
        return WrongSetting(
            f"{joint.title}: {name} reads {now} after {wanted} was restored and read back: another program writes to "
            "it, or replies are late. Stop that program."
        )

    def _check_model(self, servo: Servo) -> None:
        """Raise WrongModel if a servo of another model answers at this servo's ID."""
        found = servo.read_despite_error("Model Number")
        if found == servo.table.number or (found := servo.read_surely("Model Number")) == servo.table.number:
            return
        said = f"{servo.title}: a servo of a different model now answers at this ID."
        if found in {other.table.number for other in self.bus.drives.values()}:
            said += " Another joint has a servo of that model: their IDs may have been swapped."
        raise WrongModel(said)
