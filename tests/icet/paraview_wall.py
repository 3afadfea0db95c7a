# python3 paraview_wall.py FOLDER [LIBRARY]
# Draws on a wall of two displays, side by side, with three ranks, and writes what they show into FOLDER: wall_left.png
# and wall_right.png. LIBRARY takes IceT's place. Each rank has a display of its own, which is a file in memory.
import glob
import os
import queue
import socket
import struct
import subprocess
import sys
import tempfile
import threading

from PIL import Image

RANKS = 3
SIZE = (480, 400)
HERE = os.path.dirname(os.path.abspath(__file__))


def start_display(folder):
    """Starts an X server that keeps its picture in a file in `folder`; returns it and its name when it is ready.

    It does not reset itself when a client leaves: it would refuse the next one meanwhile."""
    read, write = os.pipe()
    server = subprocess.Popen(
        ["Xvfb", "-displayfd", str(write), "-screen", "0", "%dx%dx24" % SIZE, "-fbdir", folder, "-nolisten", "tcp",
         "-noreset"], pass_fds=[write], stderr=subprocess.DEVNULL)
    os.close(write)
    with os.fdopen(read) as number:
        name = number.readline().strip()
    if not name:
        raise SystemExit("paraview_wall.py: Xvfb has not started")
    return server, ":" + name


def read_display(folder):
    """Returns what a display shows: its file is an X window dump."""
    with open(glob.glob(folder + "/*")[0], "rb") as file:
        data = file.read()
    header = struct.unpack(">25I", data[:100])
    width, height, row = header[4], header[5], header[12]
    first = header[0] + 12 * header[19]
    return Image.frombuffer("RGB", (width, height), data[first:first + row * height], "raw", "BGRX", row, 1)


def free_port():
    with socket.socket() as some:
        some.bind(("localhost", 0))
        return some.getsockname()[1]


def follow(stream, start, log):
    """Copies `stream` to `log` meanwhile, by a thread. Returns it, and a queue that gets True for each line that starts so,
    and False at the end."""
    seen = queue.Queue()

    def copy():
        for line in stream:
            log.write(line)
            if line.startswith(start):
                seen.put(True)
        seen.put(False)

    thread = threading.Thread(target=copy)
    thread.start()
    return thread, seen


def draw(folder, library, displays, log):
    port = free_port()
    ranks = []
    for _, name, _ in displays[:RANKS]:
        ranks += [":"] if ranks else []
        ranks += ["-n", "1", "env", "DISPLAY=" + name] + (["LD_PRELOAD=" + library] if library else [])
        ranks += ["pvserver", "--force-onscreen-rendering", "--tdx=2", "--tdy=1", "--server-port=%d" % port]
    server = subprocess.Popen(["mpirun", "--oversubscribe"] + ranks, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
                              text=True)
    thread, accepts = follow(server.stdout, "Accepting connection", log)
    try:
        if not accepts.get():
            raise SystemExit("paraview_wall.py: pvserver has ended")
        client = subprocess.Popen(["pvpython", HERE + "/paraview_wall_client.py", str(port)],
                                  env=dict(os.environ, DISPLAY=displays[RANKS][1]), stdin=subprocess.PIPE,
                                  stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        if not follow(client.stdout, "drawn", log)[1].get():
            raise SystemExit("paraview_wall.py: the client has ended")
        for name, (_, _, files) in zip(("left", "right"), displays):
            read_display(files).save("%s/wall_%s.png" % (folder, name))
        client.stdin.write("seen\n")
        client.stdin.close()
        client.wait()
        server.wait()
    finally:
        server.terminate()
        thread.join()


def main():
    folder = sys.argv[1]
    library = sys.argv[2] if len(sys.argv) > 2 else ""
    with tempfile.TemporaryDirectory() as place, open(folder + "/wall.log", "w") as log:
        displays = []
        try:
            for rank in range(RANKS + 1):  # the client has the last one
                files = "%s/%d" % (place, rank)
                os.mkdir(files)
                displays.append(start_display(files) + (files,))
            draw(folder, library, displays, log)
        finally:
            for server, _, _ in displays:
                server.terminate()
                server.wait()


main()
