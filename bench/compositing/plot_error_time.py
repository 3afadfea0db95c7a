#!/usr/bin/env python3
"""Pictures of error against time: plot_error_time.py error_time.json DIR

Reads what bench_error_time has written, and writes DIR/error_time.RANKS.OUTPUT.svg for each number of ranks and output.
Needs matplotlib.
"""

import json
import os
import sys
from collections import defaultdict

import matplotlib

matplotlib.use("svg")
import matplotlib.pyplot as plt

LEAST = 1e-9  # smaller errors are drawn there
KINDS = {  # name in the file: name in the legend, colour, marker
    "dfb": ("dfb", "#0a58a8", "o"),
    "icet": ("IceT", "#c03020", "s"),
    "plain": ("plain loops over MPI", "#607050", "^"),
}


def read(path):
    """Results by (ranks, scene, output), each with its configuration without the output."""
    results = defaultdict(list)
    with open(path, encoding="utf-8") as file:
        for line in file:
            result = json.loads(line)
            config, _, output = result["config"].rpartition(", to ")
            result["config"] = config
            results[result["ranks"], result["scene"], output].append(result)
    return results


def front(results):
    """Those than which no other is faster and at least as exact, from the fastest on."""
    best = []
    for result in sorted(results, key=lambda r: (r["median_ms"], r["max_err"])):
        if not best or result["max_err"] < best[-1]["max_err"]:
            best.append(result)
    return best


def fastest_of_kinds(results):
    """Of each system and kind of pixels the fastest."""
    fastest = {}
    for result in results:
        kind = result["system"], result["config"].split(",")[0]
        if result["system"] != "dfb" and (kind not in fastest or result["median_ms"] < fastest[kind]["median_ms"]):
            fastest[kind] = result
    return list(fastest.values())


def defaults(results):
    """What a program gets that sets nothing."""
    return [r for r in results if r["system"] == "dfb" and r["config"] == "float32, defaults"]


def draw(results, title, path):
    def error(result):
        return max(result["max_err"], LEAST)

    fig, (axes, names) = plt.subplots(1, 2, figsize=(11, 5.5), width_ratios=(5, 2), sharey=True)
    for system, (name, colour, marker) in KINDS.items():
        mine = [r for r in results if r["system"] == system]
        if not mine:
            continue
        times = [r["median_ms"] for r in mine]
        spread = [[t - r["low_ms"] for t, r in zip(times, mine)], [r["high_ms"] - t for t, r in zip(times, mine)]]
        axes.errorbar(times, [error(r) for r in mine], xerr=spread, fmt=marker, color=colour, ecolor="#bbb",
                      markersize=5, label=name)
    best = front(results)
    axes.step([r["median_ms"] for r in best], [error(r) for r in best], where="post", color="#2a8a2a",
              label="nothing is faster and as exact")
    axes.set(xscale="log", yscale="log", xlabel="time of a frame [ms], median and quartiles", title=title)
    axes.set_ylabel("largest error of a pixel")
    axes.xaxis.set_major_formatter(matplotlib.ticker.FormatStrFormatter("%g"))
    axes.xaxis.set_minor_formatter(matplotlib.ticker.FormatStrFormatter("%g"))
    axes.tick_params(axis="x", which="both", labelsize=8)
    axes.set_ylim(LEAST / 2, 4 * max(error(r) for r in results))
    axes.grid(which="major", color="#eee")
    fig.legend(*axes.get_legend_handles_labels(), loc="lower center", ncol=4, fontsize=8, frameon=False)

    # Names stand in a column of their own, one below the other, each joined with its point.
    named = best + [r for r in fastest_of_kinds(results) + defaults(results) if r not in best]
    named.sort(key=error, reverse=True)
    names.axis("off")
    for i, result in enumerate(named):
        height = 0.97 - 0.94 * (i + 0.5) / len(named)
        _, colour, _ = KINDS[result["system"]]
        text = "{} {}".format(KINDS[result["system"]][0].split()[0], result["config"])
        names.text(0.02, height, text, color=colour, fontsize=8, va="center", transform=names.transAxes)
        axes.annotate("", xy=(result["median_ms"], error(result)), xytext=(0, height), textcoords=names.transAxes,
                      arrowprops={"arrowstyle": "-", "color": colour, "linewidth": 0.5, "alpha": 0.6})
    fig.tight_layout(rect=(0, 0.04, 1, 1))
    fig.savefig(path, metadata={"Date": None})
    plt.close(fig)


def main():
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    matplotlib.rcParams["svg.hashsalt"] = "dfb"  # the same file from the same results
    for (ranks, scene, output), results in read(sys.argv[1]).items():
        size = "{} x {}".format(results[0]["width"], results[0]["height"])
        kind = "noise" if scene == "noise" else output.replace(" ", "")
        title = "{}, {}, {} ranks, to {}".format(scene, size, ranks, output)
        draw(results, title, os.path.join(sys.argv[2], "error_time.{}.{}.svg".format(ranks, kind)))


main()
