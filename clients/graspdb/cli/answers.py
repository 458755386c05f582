"""``graspdb answers``."""

from __future__ import annotations

from typing import Annotated

import typer

from graspdb.cli.common import ObjectId, State, Yes, confirm, out_csv, show_table
from graspdb.cli.options import Commands
from graspdb.resources.results import Grasps

answers = Commands(no_args_is_help=True, help="Answers that the service keeps, by id or name.")

Reference = Annotated[
    str, typer.Argument(metavar="ANSWER", help="The answer's id, or its name.", show_default=False)
]


@answers.command("list")
def list_answers(
    state: State,
    id: ObjectId,
    name: Annotated[str | None, typer.Option(help="Only the answer of this name.")] = None,
    kind: Annotated[
        str | None, typer.Option(help="Only: best-grasp, likelihood, samples or proposals.")
    ] = None,
    limit: Annotated[int, typer.Option(min=1, help="At most so many.")] = 20,
) -> None:
    """List the answers about an object, the newest first."""
    state.show_list(
        state.db.answers.list(id, name=name, kind=kind).first(limit),
        {
            "answer": lambda a: a.answer,
            "names": lambda a: ", ".join(a.names),
            "question": lambda a: a.kind,
            "revision": lambda a: a.revision,
            "gripper": lambda a: a.gripper,
            "protocol": lambda a: a.protocol,
            "trials": lambda a: a.trials,
            "given": lambda a: f"{a.created_at:%Y-%m-%d %H:%M}",
        },
        empty="No answers.",
    )


@answers.command("get")
def get_answer(
    state: State,
    answer: Reference,
    now: Annotated[
        bool, typer.Option("--now", help="Ask the same question again, of today's trials.")
    ] = False,
    csv: Annotated[bool, typer.Option("--csv", help="The poses and scores of the answer as CSV.")] = False,
) -> None:
    """Show an answer as it was given, and the question to it."""
    found = state.db.answers.get(answer, now=now)
    if csv:
        out_csv(found.result.columns())
        return
    state.show(found.raw, found.summary())
    if state.json:
        return
    if isinstance(found.result, Grasps) and len(found.result) == 1:
        state.show(None, found.result[0].summary())
        return
    columns = found.result.columns()
    rows = range(min(len(found.result), 20))
    cells = {name: (lambda row, values=values: _cell(values[row])) for name, values in columns.items()}
    show_table(rows, cells, empty="No grasp.")


def _cell(value: object) -> object:
    return f"{value:.4g}" if isinstance(value, float) else value


@answers.command("delete")
def delete_answer(state: State, answer: Reference, yes: Yes = False) -> None:
    """Delete an answer by its id; by a name: free the name, and the answer where nothing else keeps it."""
    if not yes:
        found = state.db.answers.get(answer)
        confirm(f"Delete {answer}, {found.kind} of {found.object}?")
    state.db.answers.delete(answer)
    state.show({"deleted": answer}, f"{answer} is deleted.")
