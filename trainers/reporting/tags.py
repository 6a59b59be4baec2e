"""TensorBoard tags of every run, explained.

Algorithms and environments explain their own in a class variable `tags`.
"""

from __future__ import annotations

TAGS = {
    "Environment/Cumulative Reward": "Sum of an episode's rewards, weighted and not discounted: "
    "the mean over the episodes that finished since the summary before.",
    "Environment/Episode Length": "Steps of an episode: the mean over those that finished.",
    "Environment/Success Rate": "Share of the finished episodes that succeeded, where the "
    "environment says so.",
    "Environment/<Metric>": "Mean of another metric that the environment reports of finished "
    "episodes, in the metric's own unit.",
    "Environment/Lesson Number/lesson": "Present lesson of the curriculum, from 1.",
    "Reward/<name>": "Share of one reward, weighted, in the cumulative reward.",
    "Evaluation/<Figure>": "Figure of the evaluations while the run learns, which the run file's "
    "`evaluation` asks for, on the last lesson's task; where the environment judges first actions, "
    "`First Action ...` of those alone. Of errors there are `... Median` and `... P95`, the 95th "
    "percentile.",
    "Performance/Steps Per Second": "Steps of all environments in a second, since the summary "
    "before.",
    "Observations/<name>": "What the first environment's camera sees; with every tenth summary.",
    "configuration": "The resolved run file.",
}
"""What it says by tag; `<...>` stands for names that the run file or the environment brings."""
