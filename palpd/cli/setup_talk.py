"""The operator of `palpd setup --talk`: whoever sits before the page that has begun it."""

import json
import sys
from collections.abc import Sequence

from rich.console import Console

from palpd.cli.terminal import TerminalDisplay
from palpd.daemon.setup.cell import NoOperator


class TalkOperator(TerminalDisplay):
    """Asks and shows, a JSON object a line on stdout: a sentence (`say`), or a question, to which stdin gives a line with the `answer`.

    A question has its text (`ask`), the usual answer, all answers where others are refused, and the one after which the arm moves.
    """

    def __init__(self) -> None:
        super().__init__(Console(file=sys.stderr, force_terminal=False))  # which it only asks whether it is a terminal

    def say(self, sentence: str) -> None:
        """Show a sentence."""
        self._write(say=sentence)

    def ask(self, question: str, usual: str = "") -> str:
        """Ask for a text; an empty answer is the usual one. Raises NoOperator where the input has ended."""
        return self._answer(question, usual) or usual

    def choose(self, question: str, answers: Sequence[str], moves: str = "") -> str:
        """Ask for one of the answers; whatever is none of them is asked again, so that nothing moves by an empty answer."""
        while (word := self._answer(question, answers[0], answers, moves)) not in answers:
            self.say(f"{word!r} is none of {', '.join(answers)}.")
        return word

    def _answer(self, question: str, usual: str, answers: Sequence[str] = (), moves: str = "") -> str:
        self._write(ask=question, usual=usual, answers=answers, moves=moves)
        if not (line := sys.stdin.readline()):
            raise NoOperator("a question has no answer, since the page has ended; palpd setup goes on there")
        return str(json.loads(line)["answer"]).strip()

    def _write(self, **content: object) -> None:
        print(f"\n{json.dumps(content)}", flush=True)  # the first line break ends what a library has begun to print
