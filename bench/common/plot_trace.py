#!/usr/bin/env python3
"""Picture of one frame of a trace: plot_trace.py TRACE.json PICTURE.png [FRAME]

Reads what dfb_render or a benchmark has written with --trace. Draws a row for each rank, with the spans of all its
threads, and lines for some of the inputs between ranks. Takes the frame of median time if none is named. Prints the
time of each kind of span, over all ranks. Needs matplotlib.
"""

import json
import sys
from collections import defaultdict

import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt

COLOURS = {"wait": "#dddddd", "setTile": "#5b8bd0", "finish": "#e08a3c"}  # from the back to the front
MOST_LINES = 25


def frames_together(spans, number):
    """A frame on all ranks: that of this number, or if it is None of median time. Framebuffers number theirs alike."""
    frames = sorted((s for s in spans if s["name"] == "frame"), key=lambda s: s["dur"])
    if number is not None:
        frames = [s for s in frames if s["args"]["frame"] == number]
    if not frames:
        sys.exit("plot_trace.py: there is no frame {}in {}".format("" if number is None else "{} ".format(number), sys.argv[1]))
    one = frames[len(frames) // 2]
    return [s for s in frames if s["args"]["frame"] == one["args"]["frame"]
            and s["ts"] < one["ts"] + one["dur"] and one["ts"] < s["ts"] + s["dur"]]


def inputs_between(events, begin, end):
    """(sender, time, receiver, time) of each input that was sent then."""
    flows = [e for e in events if e["ph"] in "sf" and e["name"] == "input"]
    received = {e["id"]: e for e in flows if e["ph"] == "f"}
    pairs = [(e, received[e["id"]]) for e in flows if e["ph"] == "s" and begin <= e["ts"] <= end]
    return sorted((s["pid"], s["ts"], f["pid"], f["ts"]) for s, f in pairs)


def draw(spans, inputs, begin, path):
    ranks = sorted({s["pid"] for s in spans})
    figure, axes = plt.subplots(figsize=(9, 0.9 + 0.5 * len(ranks)), dpi=100)
    legend = []
    for name, colour in COLOURS.items():
        for rank in ranks:
            bars = [((s["ts"] - begin) / 1e3, s["dur"] / 1e3) for s in spans if s["name"] == name and s["pid"] == rank]
            axes.broken_barh(bars, (rank - 0.25, 0.5), facecolor=colour, linewidth=0)
        legend.append(plt.Rectangle((0, 0), 1, 1, color=colour, label=name))
    every = max(1, -(-len(inputs) // MOST_LINES))
    for sender, sent, receiver, taken in inputs[::every]:
        axes.plot([(sent - begin) / 1e3, (taken - begin) / 1e3], [sender, receiver], color="#777777", linewidth=0.5)
    if inputs:
        label = "an input" if every == 1 else "an input, one of {} each".format(every)
        legend.append(plt.Line2D([], [], color="#777777", linewidth=0.5, label=label))
    for span in spans:
        if span["name"] == "verdict":
            at = (span["ts"] - begin) / 1e3
            axes.plot([at, at], [span["pid"] - 0.35, span["pid"] + 0.35], color="black", linewidth=1.5)
    legend.append(plt.Line2D([], [], color="black", linewidth=1.5, label="vote"))
    axes.set_yticks(ranks, ["rank {}".format(rank) for rank in ranks])
    axes.invert_yaxis()
    axes.set_xlim(left=0)
    axes.set_xlabel("ms")
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(handles=legend, ncol=len(legend), loc="lower center", bbox_to_anchor=(0.5, 1), frameon=False, fontsize=8)
    figure.tight_layout()
    figure.savefig(path)


def main():
    if len(sys.argv) not in (3, 4):
        sys.exit(__doc__)
    with open(sys.argv[1], encoding="utf-8") as file:
        events = json.load(file)["traceEvents"]
    spans = [e for e in events if e["ph"] == "X"]
    frames = frames_together(spans, int(sys.argv[3]) if len(sys.argv) > 3 else None)
    begin = min(s["ts"] for s in frames)
    end = max(s["ts"] + s["dur"] for s in frames)
    number = frames[0]["args"]["frame"]
    spans = [s for s in spans if s["args"]["frame"] == number and begin <= s["ts"] <= end]
    print("frame {}: {:.2f} ms".format(number, (end - begin) / 1e3))
    names = defaultdict(list)
    for span in spans:
        names[span["name"]].append(span["dur"] / 1e3)
    for name, times in sorted(names.items(), key=lambda item: -sum(item[1])):
        print("{:24} {:5} spans, {:9.3f} ms, the longest {:.3f} ms".format(name, len(times), sum(times), max(times)))
    draw(spans, inputs_between(events, begin, end), begin, sys.argv[2])


if __name__ == "__main__":
    main()
