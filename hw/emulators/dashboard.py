"""The dashboard of a UR controller: what it answers, and what an operator does there."""

from hw.emulators.controller_state import FIT, PROGRAM_STOP_M_PER_S2, UNPOWERED, ControllerState, Power, Runtime, Safety

UNLOCK_AFTER_S = 5.0
"""Age of a protective stop before which it cannot be unlocked."""
_UNLOCK_TOO_EARLY = "Cannot unlock protective stop until 5s after occurrence. Always inspect cause of protective stop before unlocking"
_FIXED_ANSWERS = {
    "close safety popup": "closing safety popup",
    "close popup": "closing popup",
    "get loaded program": "Loaded program: /programs/rtde_control.urp",
    "isprogramsaved": "true null",
}
"""Answers of the dashboard that do not depend on the controller's state."""
_COMMANDS = {"play", "stop", "pause", "unlock protective stop", "power on", "power off", "brake release", "restart safety"}
"""What the dashboard carries out in remote control only."""


class Dashboard:
    """The dashboard server, without its socket."""

    def __init__(self, state: ControllerState) -> None:
        self._state = state

    def answer(self, asked: str, now_s: float) -> str:
        """Answer a command or a question; exact texts as the real server sends them."""
        line = asked.lower()
        if not self._state.remote_control and line in _COMMANDS:
            return "Command is not allowed due to safety reasons, please switch robot to Remote Control mode and reconnect to port 29999"
        answer = self.obey(line, now_s) or self._report(line) or _FIXED_ANSWERS.get(line)
        return answer or f'could not understand: "{asked}"'

    def obey(self, command: str, now_s: float) -> str | None:
        """Carry out a command, also in local control: an operator has a button for each at the pendant.

        Args:
            command: as the dashboard takes it, in small letters.
            now_s: host time.

        Returns:
            The answer; None if it is no command.
        """
        match command:
            case "play":
                return "Starting program" if self.play() else "Failed to execute: play"
            case "stop":
                self._state.stop_program(now_s, "stopped at the dashboard")
                return "Stopped"
            case "pause":
                return "Pausing program" if self.pause() else "Failed to execute: pause"
            case "unlock protective stop":
                return "Protective stop releasing" if self.unlock(now_s) else _UNLOCK_TOO_EARLY
            case "power on":
                self.power_on()
                return "Powering on"
            case "power off":
                self.power_off(now_s)
                return "Powering off"
            case "brake release":
                self.release_brakes()
                return "Brake releasing"
            case "restart safety":
                self.restart_safety()
                return "Restarting safety"
            case _:
                return None

    def _report(self, question: str) -> str | None:
        """Report the controller's state; None if nothing of it is asked."""
        state = self._state
        playing = state.runtime is Runtime.PLAYING
        answers = {
            "running": f"Program running: {str(playing).lower()}",
            "robotmode": f"Robotmode: {state.power.name}",
            "safetymode": f"Safetymode: {state.safety.name}",
            "safetystatus": f"Safetystatus: {state.safety.name}",
            "programstate": f"{'PLAYING' if playing else 'PAUSED' if state.runtime is Runtime.PAUSED else 'STOPPED'} rtde_control.urp",
            "polyscopeversion": state.model.polyscope,
        }
        if state.model.e_series:
            answers |= {"get serial number": state.model.serial_number, "get robot model": "UR5"}
            answers["is in remote control"] = str(state.remote_control).lower()
        return answers.get(question)

    def play(self) -> bool:
        """Resume a paused program. Returns False where none is paused."""
        if self._state.runtime is not Runtime.PAUSED or self._state.safety not in FIT or self._state.program is None:
            return False
        self._state.runtime = Runtime.PLAYING
        return True

    def pause(self) -> bool:
        """Pause a running program. Returns False where none runs."""
        if self._state.runtime is not Runtime.PLAYING:
            return False
        self._state.runtime = Runtime.PAUSED
        self._state.halt(PROGRAM_STOP_M_PER_S2)
        return True

    def unlock(self, now_s: float) -> bool:
        """Release a protective stop. Returns False while it is younger than `UNLOCK_AFTER_S`."""
        if self._state.safety is Safety.PROTECTIVE_STOP:
            if now_s - self._state.stopped_s < UNLOCK_AFTER_S:
                return False
            self._state.safety = Safety.NORMAL
        return True

    def power_off(self, now_s: float) -> None:
        """End the program and cut the power."""
        self._state.stop_program(now_s, "power off")
        self._state.power = Power.POWER_OFF

    def power_on(self) -> None:
        """Switch the power on, brakes still on. It releases no stop, and does nothing while a stop or a fault cuts the power."""
        if self._state.power is Power.POWER_OFF and self._state.safety not in UNPOWERED:
            self._state.power = Power.IDLE

    def release_brakes(self) -> None:
        """Switch the power on and release the brakes."""
        self.power_on()
        if self._state.power is Power.IDLE:
            self._state.power = Power.RUNNING

    def restart_safety(self) -> None:
        """End a violation or a fault; the arm stays without power."""
        if self._state.safety in (Safety.VIOLATION, Safety.FAULT):
            self._state.safety = Safety.NORMAL
