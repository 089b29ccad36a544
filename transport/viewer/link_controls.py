"""Widgets that impair the links of an active run: one link, all links, or those between groups."""

from collections.abc import Mapping, Sequence
from typing import Any

from transport.flight.active_runs import Commands
from transport.protocol.scenario.links.delay_jitter_and_loss import Link
from transport.protocol.scenario.links.link_changes import LinkChanges, split_groups
from transport.protocol.scenario.sections.link_sections import LinkSection
from transport.protocol.wire.messages import agent_name
from transport.scene.history import RunHistory
from transport.viewer import panel_values
from transport.viewer.server import NOTIFICATION_S

ALL_LINKS = "all links"
# Largest delay of the slider, s.
_MOST_S = 1.0

Ends = tuple[int, int]  # sender and receiver of a link, agents


class LinksInForce:
    """Impairments of the links between agents, as far as the changes of a run have been read."""

    def __init__(self, history: RunHistory) -> None:
        self._history = history
        setup = history.setup
        self._links: dict[Ends, Link] = {
            (sender, receiver): Link(
                setup.scenario.links,
                agent_name(sender),
                agent_name(receiver),
                seed=setup.scenario.seed,
                period_s=setup.settings.sampling_period_s,
            )
            for sender in setup.agents
            for receiver in setup.agents
            if sender != receiver
        }
        self._changes = LinkChanges(self._links.values())
        self._applied = 0

    def read(self) -> None:
        """Apply the changes that have been read since the last call."""
        changes = self._history.link_changes
        for change in changes[self._applied :]:
            self._changes.apply(change)
        self._applied = len(changes)

    def of_links(self, ends: Ends | None) -> Mapping[Ends, LinkSection]:
        """Return the impairments of one link, or of all, that apply to messages from now on."""
        chosen = self._links if ends is None else {ends: self._links[ends]}
        tick = max([0, self._history.last, *(change.tick for change in self._history.link_changes)])
        return {pair: link.impairments(tick) for pair, link in chosen.items()}


class LinkControls:
    """Widgets in a folder that delay, impair, cut and clear links between agents."""

    def __init__(self, gui: Any, history: RunHistory, commands: Commands) -> None:
        setup = history.setup
        self._agents = tuple(setup.agents)
        self._commands = commands
        self._in_force = LinksInForce(history)
        self._shown: Mapping[Ends, LinkSection] = {}
        # What was filled in last: a slider that shows something else has been moved.
        self._filled_s = 0.0
        self._filled_percent = 0
        self._ends = {
            f"{sender} to {receiver}": (sender, receiver)
            for sender in self._agents
            for receiver in self._agents
            if sender != receiver
        }
        self.folder = gui.add_folder("Links", visible=bool(self._ends))
        with self.folder:
            self._chosen = gui.add_dropdown("link", (ALL_LINKS, *self._ends))
            self._delay = gui.add_slider("delay (s)", 0.0, _MOST_S, 0.01, 0.0)
            self._loss = gui.add_slider("loss (%)", 0, 100, 1, 0)
            change = gui.add_button("Set")
            self._groups = gui.add_text(
                "groups",
                _half(self._agents),
                hint="groups of agents that lose all messages of each other: 1, 2 | 3; "
                "agents that are not named are a further group",
            )
            cut = gui.add_button("Cut between groups")
            clear = gui.add_button("Clear all links")
            self._state = gui.add_html("")

        self._chosen.on_update(lambda _: self._show_values())
        change.on_click(self._change)
        cut.on_click(self._cut)
        clear.on_click(lambda _: commands.clear())
        self.show()

    def show(self) -> None:
        """Move the sliders to the impairments in force if these have changed."""
        self._in_force.read()
        in_force = self._in_force.of_links(None)
        if in_force != self._shown:
            self._shown = in_force
            self._show_values()
            self._state.content = panel_values.links(in_force)

    def _show_values(self) -> None:
        """Move the sliders to the values of the chosen link; for all links, where they agree."""
        chosen = self._in_force.of_links(self._ends.get(self._chosen.value)).values()
        delays_s = {section.delay_s for section in chosen}
        losses = {section.loss for section in chosen}
        if len(delays_s) == 1:
            self._filled_s = min(delays_s.pop(), _MOST_S)
            self._delay.value = self._filled_s
        if len(losses) == 1:
            self._filled_percent = round(100.0 * losses.pop())
            self._loss.value = self._filled_percent

    def _change(self, event: Any) -> None:
        """Send what has been moved: a slider need not show the exact value in force."""
        settings = {}
        if self._delay.value != self._filled_s:
            settings["delay_s"] = round(self._delay.value, 3)
        if self._loss.value != self._filled_percent:
            settings["loss"] = self._loss.value / 100.0
        if not settings:
            event.client.add_notification(
                "Links", "no slider has been moved", auto_close_seconds=NOTIFICATION_S
            )
            return
        self._commands.link(self._ends.get(self._chosen.value), settings)

    def _cut(self, event: Any) -> None:
        try:
            groups = groups_of(self._groups.value, self._agents)
        except ValueError as error:
            event.client.add_notification("Links", str(error), auto_close_seconds=NOTIFICATION_S)
            return
        self._commands.cut(groups)


def groups_of(text: str, agents: Sequence[int]) -> list[list[int]]:
    """Return the groups of agents in a text such as "1, 2 | 3", as `split_groups` reads it.

    Agents that are not named are a further group.

    Raises: ValueError: no groups of these agents, with what was expected.
    """
    groups = []
    left = list(agents)
    for numbers in split_groups(text):
        try:
            group = [int(number) for number in numbers]
            for agent in group:
                left.remove(agent)
        except ValueError:
            raise ValueError(
                f"groups: expected each of the agents {agents[0]} to {agents[-1]} at most once, "
                f"with | between groups, got {text[:40]!r}"
            ) from None
        groups.append(group)
    groups = [group for group in (*groups, left) if group]
    if len(groups) < 2:
        raise ValueError(f"groups: expected at least two groups of agents, got {text[:40]!r}")
    return groups


def _half(agents: Sequence[int]) -> str:
    """Return the first half of the agents as text."""
    return ", ".join(map(str, agents[: max(1, len(agents) // 2)]))
