#!/usr/bin/env python3
"""Plots of where the time of dfb_render went: plot_stats.py PREFIX STATS.json...

Each STATS.json is what a run has written with --stats. Runs that differ in nothing but the number of ranks are a
series. Prints a table, and writes

  PREFIX.scaling.svg    frames a second over the number of ranks, beside what twice the ranks would ideally give
  PREFIX.breakdown.svg  the time of a frame on the slowest rank: its rendering, and compositing after that
  PREFIX.frames.svg     the time of each frame, if there are runs of several

A frame's time is the median of the run's frames, without the first of several; writing files is left out.
Needs matplotlib; with --table in place of PREFIX it prints the table alone, and needs nothing.
"""

import json
import os
import statistics
import sys
from collections import defaultdict

COLOURS = ["#0a58a8", "#c03020", "#2a8a2a", "#8a5a00", "#703090", "#607050"]
# Options that say how many ranks there are, or what is written and not how long it takes.
NOT_COMPARED = {"ranks", "stats", "trace", "output", "cinema", "alpha", "depth", "aux", "frames", "seed"}


class Run:
    def __init__(self, path):
        with open(path, encoding="utf-8") as file:
            stats = json.load(file)
        self.ranks = stats["ranks"]
        self.options = {k: v for k, v in stats["options"].items() if k not in NOT_COMPARED}
        self.options["scene"] = " ".join(os.path.basename(word) for word in stats["scene"])
        self.render = [frame["render_ms"] for frame in stats["frames"]]
        self.compositing = [frame["compositing_ms"] for frame in stats["frames"]]
        self.times = [a + b for a, b in zip(self.render, self.compositing)]
        if not self.times:
            raise ValueError(path + " has no frames")

    def median(self, values):
        return statistics.median(values[1:] if len(values) > 1 else values)

    @property
    def frame_ms(self):
        return self.median(self.times)


def series_of(runs):
    """Runs by what they have in common, each list by the number of ranks; the name says what tells it from others."""
    groups = defaultdict(list)
    for run in runs:
        groups[json.dumps(run.options, sort_keys=True)].append(run)
    keys = sorted({key for run in runs for key in run.options})
    different = [key for key in keys if len({str(run.options.get(key)) for run in runs}) > 1]
    named = {}
    for group in groups.values():
        options = group[0].options
        words = ["{} {}".format(key, options[key]) if key not in ("scene", "mode", "size") else str(options[key])
                 for key in different if key in options]
        name = ", ".join(words) or "{}, {}".format(options["scene"], options.get("size", ""))
        named[name] = sorted(group, key=lambda run: run.ranks)
    return dict(sorted(named.items()))


def print_table(series):
    print("| series | ranks | frames | ms a frame | frames a second | render ms | compositing ms |")
    print("|---|---|---|---|---|---|---|")
    for name, runs in series.items():
        for run in runs:
            print("| {} | {} | {} | {:.1f} | {:.2f} | {:.1f} | {:.1f} |".format(
                name, run.ranks, len(run.times), run.frame_ms, 1000 / run.frame_ms, run.median(run.render),
                run.median(run.compositing)))


def ticks_of_ranks(axes, runs):
    ranks = sorted({run.ranks for run in runs})
    axes.set_xticks(ranks)
    axes.set_xticklabels([str(r) for r in ranks])
    axes.set_xticks([], minor=True)


def draw_scaling(plt, series, path):
    fig, axes = plt.subplots(figsize=(5.5, 4))
    for colour, (name, runs) in zip(COLOURS * len(series), series.items()):
        ranks = [run.ranks for run in runs]
        rates = [1000 / run.frame_ms for run in runs]
        axes.plot(ranks, rates, "o-", color=colour, label=name)
        if len(ranks) > 1:
            axes.plot(ranks, [rates[0] * r / ranks[0] for r in ranks], "--", color=colour, alpha=0.4)
    axes.set_xscale("log", base=2)
    axes.set_yscale("log", base=2)
    axes.yaxis.set_major_formatter(plt.matplotlib.ticker.FormatStrFormatter("%g"))
    axes.set(xlabel="ranks", ylabel="frames a second (dashed: ideal)")
    ticks_of_ranks(axes, [run for runs in series.values() for run in runs])
    axes.grid(color="#eee")
    axes.legend(fontsize=8, frameon=False)
    save(plt, fig, path)


def draw_breakdown(plt, series, path):
    fig, all_axes = plt.subplots(1, len(series), figsize=(max(5.5, 3 * len(series)), 4), sharey=True, squeeze=False)
    for colour, axes, (name, runs) in zip(COLOURS * len(series), all_axes[0], series.items()):
        places = range(len(runs))
        render = [run.median(run.render) for run in runs]
        axes.bar(places, render, color=colour, label="rendering, slowest rank")
        axes.bar(places, [run.median(run.compositing) for run in runs], bottom=render, color=colour, alpha=0.4,
                 label="compositing after that")
        axes.set_xticks(list(places))
        axes.set_xticklabels([str(run.ranks) for run in runs])
        axes.set_title(name, fontsize=8)
        axes.set_xlabel("ranks")
        axes.legend(fontsize=8, frameon=False)
    all_axes[0][0].set_ylabel("ms a frame")
    all_axes[0][0].set_ylim(top=1.25 * max(run.frame_ms for runs in series.values() for run in runs))  # for the legend
    save(plt, fig, path)


def draw_frames(plt, series, path):
    fig, axes = plt.subplots(figsize=(6.5, 4))
    for colour, (name, runs) in zip(COLOURS * len(series), series.items()):
        for i, run in enumerate(run for run in runs if len(run.times) > 1):
            axes.plot(range(len(run.times)), run.times, color=colour, alpha=1 / (1 + 0.5 * i),
                      label="{}, {} ranks".format(name, run.ranks))
    axes.set(xlabel="frame", ylabel="ms")
    axes.set_ylim(bottom=0)
    axes.grid(color="#eee")
    axes.legend(fontsize=8, frameon=False)
    save(plt, fig, path)


def save(plt, fig, path):
    fig.tight_layout()
    fig.savefig(path, metadata={"Date": None})
    plt.close(fig)
    print("wrote " + path)


def main():
    if len(sys.argv) < 3 or (sys.argv[1].startswith("-") and sys.argv[1] != "--table"):
        sys.exit(__doc__)
    try:
        series = series_of([Run(path) for path in sys.argv[2:]])
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as wrong:
        sys.exit("plot_stats.py: no statistics of dfb_render: {}".format(wrong))
    print_table(series)
    if sys.argv[1] == "--table":
        return
    try:
        import matplotlib
    except ImportError:
        sys.exit("plot_stats.py: needs matplotlib (Debian: python3-matplotlib), or --table")
    matplotlib.use("svg")
    matplotlib.rcParams["svg.hashsalt"] = "dfb"  # the same file from the same numbers
    matplotlib.rcParams["svg.fonttype"] = "none"  # text stays text
    import matplotlib.pyplot as plt
    import matplotlib.ticker

    draw_scaling(plt, series, sys.argv[1] + ".scaling.svg")
    draw_breakdown(plt, series, sys.argv[1] + ".breakdown.svg")
    if any(len(run.times) > 1 for runs in series.values() for run in runs):
        draw_frames(plt, series, sys.argv[1] + ".frames.svg")


main()
