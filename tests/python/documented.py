"""The blocks of Python in the documentation run, with the names that its text introduces."""
import os
import re
import unittest

import numpy

import dfb

ROOT = os.path.join(os.path.dirname(os.path.abspath(__file__)), "..", "..")


def blocks(path):
    with open(os.path.join(ROOT, path), encoding="utf-8") as file:
        return re.findall(r"^```python\n(.*?)^```", file.read(), re.MULTILINE | re.DOTALL)


def march(data, origins, directions):
    height, width, _ = origins.shape
    return numpy.full((height, width, 4), data, numpy.float32), numpy.full((height, width), 1, numpy.float32)


def read(name):
    level, alpha = {"front.png": (200, 127), "middle.png": (100, 255), "back.png": (20, 255)}[name]
    image = numpy.full((80, 100, 4), level, numpy.uint8)
    image[..., 3] = alpha
    return image


class Documented(unittest.TestCase):
    def test_blocks(self):
        for page, count in (("docs/recipes.md", 4), ("examples/adapters/python/README.md", 1)):
            found = blocks(page)
            self.assertEqual(len(found), count, page)
            shown = []

            def rank(comm):
                names = {"dfb": dfb, "numpy": numpy, "comm": comm, "width": 100, "height": 80, "march": march, "field": 0.5,
                         "show": shown.append, "rgba": numpy.full((80, 100, 4), comm.rank + 1, numpy.uint8),
                         "depth": numpy.full((80, 100), 2 - comm.rank, numpy.float32), "read": read}
                for number, block in enumerate(found):
                    exec(compile(block, f"{page}, block {number + 1}", "exec"), names)
                return names

            names = dfb.run_ranks(2, rank)[0]
            self.assertEqual([image.shape for image in shown], [(80, 100, 4)])
            self.assertTrue((shown[0] == 2).all())
            if "picture" in names: # level 200 at half opacity over 100 over 20: 127 / 255, then opaque
                self.assertEqual(names["picture"].shape, (80, 100, 4))
                self.assertTrue((names["picture"] == [150, 150, 150, 255]).all(), names["picture"][0, 0])


if __name__ == "__main__":
    unittest.main()
