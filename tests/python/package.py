"""The package: its type hints name what there is, and everything is documented."""
import ast
import inspect
import os
import unittest

import dfb

FOLDER = os.path.dirname(dfb.__file__)


def hints():
    with open(os.path.join(FOLDER, "__init__.pyi"), encoding="utf-8") as file:
        return ast.parse(file.read()).body


def public(names):
    return {name for name in names if not name.startswith("_")}


class Package(unittest.TestCase):
    def test_hints_name_what_there_is(self):
        hinted = {node.name: node for node in hints() if isinstance(node, (ast.ClassDef, ast.FunctionDef))}
        values = {node.target.id for node in hints() if isinstance(node, ast.AnnAssign)}
        self.assertEqual(public(hinted) | public(values), set(dfb.__all__))
        self.assertTrue(os.path.exists(os.path.join(FOLDER, "py.typed")))
        for name, node in hinted.items():
            if not isinstance(node, ast.ClassDef):
                continue
            members = {m.name if isinstance(m, ast.FunctionDef) else m.target.id
                       for m in node.body if not isinstance(m, ast.Expr)}
            for base in node.bases:
                if base.id == "_Collective":
                    members |= {m.name for m in hinted["_Collective"].body}
            kind = getattr(dfb, name)
            missing = public(members) - set(dir(kind))
            if name in ("Error", "Brick"):  # their attributes are an object's
                missing -= set(vars(dfb.Error() if name == "Error" else dfb.Brick(0, 0, 0)))
            self.assertEqual(missing, set(), name)
            own = {m for m in public(dir(kind)) if m not in dir(RuntimeError)}
            self.assertEqual(own - public(members), set(), name)

    def test_hints_have_the_arguments(self):
        hinted = {node.name: node for node in hints() if isinstance(node, ast.ClassDef)}
        for name in ("ImageCompositor", "FrameBuffer", "Brick", "Error"):
            for function in hinted[name].body:
                if isinstance(function, ast.FunctionDef) and function.name in ("__init__", "composite", "render"):
                    there = inspect.signature(getattr(getattr(dfb, name), function.name)).parameters
                    a = function.args
                    self.assertEqual([x.arg for x in a.args + a.kwonlyargs], list(there), (name, function.name))
                    optional = [p.name for p in there.values() if p.default is not p.empty]
                    self.assertEqual([x.arg for x in (a.args[len(a.args) - len(a.defaults):] if a.defaults else [])]
                                     + [x.arg for x in a.kwonlyargs], optional)

    def test_documented(self):
        for name in dfb.__all__:
            thing = getattr(dfb, name)
            if name == "has_mpi":
                continue
            self.assertTrue(thing.__doc__, name)
            self.assertTrue(thing.__module__ == "dfb", (name, thing.__module__))
            for member in public(vars(thing) if inspect.isclass(thing) else ()):
                if member not in ("width", "height", "image_width", "image_height"):
                    self.assertTrue(getattr(thing, member).__doc__, (name, member))
        self.assertRegex(dfb.__version__, r"^\d+\.\d+\.\d+$")
        self.assertTrue(dfb.__doc__)


if __name__ == "__main__":
    unittest.main()
