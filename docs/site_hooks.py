"""The command reference, from the commands themselves when the site is built."""

from typing import Any

import typer.main

MARK = "<!-- commands -->"


def on_page_markdown(markdown: str, **_: Any) -> str:
    """mkdocs calls this for each page."""
    return markdown.replace(MARK, command_reference()) if MARK in markdown else markdown


def command_reference() -> str:
    """Every subcommand's help as Markdown."""
    from hil.cli.app import app

    group: Any = typer.main.get_command(app)
    with group.make_context("hil", [], resilient_parsing=True) as context:
        pages = []
        for name in group.list_commands(context):
            command = group.get_command(context, name)
            with command.make_context(name, [], parent=context, resilient_parsing=True) as inner:
                pages.append(f"## hil {name}\n\n```text\n{command.get_help(inner)}\n```\n")
    return "\n".join(pages)
