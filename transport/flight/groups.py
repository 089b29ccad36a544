"""Groups of agents as text, as the command line and the viewer take them."""

import re


def split_groups(text: str) -> list[list[str]]:
    """Return the agents of each group in a text such as "1,2/3,4".

    Between groups is a slash, or a bar, which a shell would take as a pipe; between agents a comma
    or blanks.
    """
    return [group.replace(",", " ").split() for group in re.split("[/|]", text)]
