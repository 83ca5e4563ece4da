"""Copies of modules whose derivatives pass through the switches of ``mutants``."""

from __future__ import annotations

import ast
import importlib
import inspect
from collections.abc import Iterable
from types import ModuleType
from typing import Any

from drgs.core.registry import temporary_registrations
from support.mutants import (
    _COMPARISONS,
    _HAND_OVERS,
    EVALUATED_ONLY,
    SAME_AT_EQUALITY,
    Site,
    Switchboard,
)


class Instrumented:
    """A copy of a module whose derivative functions pass their values through switches.

    derivatives: names of the functions or methods with which derivatives are entered; forward:
    those of the forward pass. What is reached from the former alone is instrumented. Of what both
    reach, comparisons are: such a mutant is a decision of the forward pass that the derivative,
    which alone is run from the copy, does not replay.

    names: to be replaced in the copy's namespace.
    """

    def __init__(
        self,
        switchboard: Switchboard,
        module: ModuleType | str,
        derivatives: Iterable[str],
        forward: Iterable[str],
        **names: Any,
    ) -> None:
        is_source = isinstance(module, str)
        self.namespace = {"__name__": "sample" if is_source else module.__name__}
        tree = ast.parse(module if is_source else inspect.getsource(module))
        reached, shared = (_reachable(tree, roots) for roots in (derivatives, forward))
        short_name = self.namespace["__name__"].rpartition(".")[2]
        package = _package_functions(tree)
        for name, node in _definitions(tree).items():
            if name in reached:
                label, is_derivative = f"{short_name}.{name}", name not in shared
                _Instrumenter(switchboard.sites, label, node, package, is_derivative)
        ast.fix_missing_locations(tree)
        self.namespace["__switchboard__"] = switchboard
        with temporary_registrations():
            exec(compile(tree, "sample" if is_source else module.__file__, "exec"), self.namespace)
        self.namespace.update(names)

    def __getitem__(self, name: str) -> Any:
        return self.namespace[name]


def _definitions(tree: ast.Module) -> dict[str, ast.FunctionDef]:
    """Functions and methods of a module by qualified name."""
    result = {}
    for node in tree.body:
        if isinstance(node, ast.FunctionDef):
            result[node.name] = node
        if isinstance(node, ast.ClassDef):
            for method in node.body:
                if isinstance(method, ast.FunctionDef):
                    result[f"{node.name}.{method.name}"] = method
    return result


def _imports(tree: ast.Module) -> list[tuple[str, str]]:
    """(module, name in this module's namespace)."""
    return [
        (getattr(node, "module", None) or alias.name, alias.asname or alias.name)
        for node in tree.body
        if isinstance(node, (ast.Import, ast.ImportFrom))
        for alias in node.names
    ]


def _package_functions(tree: ast.Module) -> set[str]:
    """Names of functions and methods that the module defines or has from its package.

    Those of methods include all of the modules that it imports from.
    """
    ours = [(module, name) for module, name in _imports(tree) if module.startswith("drgs.")]
    defined = set(_definitions(tree))
    for module in {module for module, _ in ours}:
        source = inspect.getsource(importlib.import_module(module))
        defined |= {name for name in _definitions(ast.parse(source)) if "." in name}
    return {name for _, name in ours} | {name.rpartition(".")[2] for name in defined}


def _extending_others(tree: ast.Module) -> set[str]:
    """Classes whose base is not of this package: others call their methods."""
    ours = {name for module, name in _imports(tree) if module.startswith("drgs.")}
    classes = [node for node in tree.body if isinstance(node, ast.ClassDef)]
    ours |= {node.name for node in classes}
    return {node.name for node in classes if {ast.unparse(base) for base in node.bases} - ours}


def _reachable(tree: ast.Module, roots: Iterable[str]) -> set[str]:
    """Functions and methods that ``roots`` may call, by the names that they mention."""
    definitions, imported = _definitions(tree), {name for _, name in _imports(tree)}
    frameworks = _extending_others(tree)
    by_mention: dict[str, list[str]] = {}
    for name in definitions:
        owner, _, method = name.rpartition(".")
        unnamed = method.startswith("__") or owner in frameworks
        by_mention.setdefault(owner if unnamed and owner else method, []).append(name)
    reached: set[str] = set()
    pending = list(roots)
    assert set(pending) <= set(definitions), set(pending) - set(definitions)
    while pending:
        name = pending.pop()
        if name in reached:
            continue
        reached.add(name)
        statements = definitions[name].body  # and not the annotations
        for node in (n for statement in statements for n in ast.walk(statement)):
            if isinstance(node, ast.Name):
                pending += by_mention.get(node.id, [])
            elif isinstance(node, ast.Attribute) and ast.unparse(node.value) not in imported:
                pending += by_mention.get(node.attr, [])
    return reached


class _Instrumenter(ast.NodeTransformer):
    """Rewrites the body of one function in place."""

    def __init__(
        self,
        sites: list[Site],
        function: str,
        node: ast.FunctionDef,
        package: set[str],
        is_derivative: bool,
    ) -> None:
        self.sites, self.function = sites, function
        self.package, self.is_derivative = package, is_derivative
        self.only_evaluated = _only_evaluated(node)
        self.nesting = 0
        node.body = [self.visit(statement) for statement in node.body]

    def _site(self, node: ast.expr, text: str = "", **fields: Any) -> int:
        text = " ".join((text or ast.unparse(node)).split())
        self.sites.append(Site(self.function, node.lineno, text, **fields))
        return len(self.sites) - 1

    @staticmethod
    def _call(method: str, *args: Any) -> ast.Call:
        nodes = [a if isinstance(a, ast.AST) else ast.Constant(a) for a in args]
        board = ast.Name("__switchboard__", ast.Load())
        return ast.Call(ast.Attribute(board, method, ast.Load()), nodes, [])

    def _scaled(self, node: ast.expr, text: str = "", **fields: Any) -> ast.expr:
        """Visit ``node`` and make its value a site."""
        if isinstance(node, ast.Starred):
            node.value = self._scaled(node.value)
            return node
        if not self.is_derivative or _has_own_sites(node):
            return self.visit(node)
        index = self._site(node, text, **fields)
        return ast.copy_location(self._call("scale", index, self.visit(node)), node)

    def _made_here(self, node: ast.expr, text: str = "", **fields: Any) -> ast.expr:
        """The same, unless the value came into being elsewhere."""
        if isinstance(node, (ast.Name, ast.Attribute, ast.Subscript)):
            return self.visit(node)
        if isinstance(node, ast.Call) and _called(node) in {"list", *self.package}:
            return self.visit(node)
        return self._scaled(node, text, **fields)

    # Statements

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.FunctionDef:
        self.nesting += 1
        node.body = [self.visit(statement) for statement in node.body]
        self.nesting -= 1
        return node

    def visit_Assign(self, node: ast.Assign) -> ast.Assign:
        (target,) = node.targets
        fields = {}
        if isinstance(target, ast.Tuple):
            fields["parts"] = tuple(ast.unparse(element) for element in target.elts)
        if isinstance(target, ast.Name) and target.id in self.only_evaluated:
            fields["reason"] = EVALUATED_ONLY
        node.value = self._made_here(node.value, ast.unparse(node), **fields)
        return node

    def visit_Raise(self, node: ast.Raise) -> ast.Raise:
        return node  # a message

    def visit_AnnAssign(self, node: ast.AnnAssign) -> ast.AnnAssign:
        if node.value is not None:
            node.value = self._made_here(node.value, ast.unparse(node))
        return node

    def visit_AugAssign(self, node: ast.AugAssign) -> ast.AugAssign:
        node.value = self._scaled(node.value, ast.unparse(node))
        return node

    def visit_Return(self, node: ast.Return) -> ast.Return:
        if node.value is not None:
            node.value = self._made_here(node.value, ast.unparse(node))
        if node.value is not None and self.is_derivative and not self.nesting:
            call = self._call("returned", self.function, node.value)
            node.value = ast.copy_location(call, node.value)
        return node

    # Expressions

    def visit_Subscript(self, node: ast.Subscript) -> ast.Subscript:
        node.value = self.visit(node.value)  # and no site in an index
        return node

    def visit_List(self, node: ast.List) -> ast.List:
        node.elts = [self._scaled(element) for element in node.elts]
        return node

    def visit_Tuple(self, node: ast.Tuple) -> ast.Tuple:
        if isinstance(node.ctx, ast.Load):
            node.elts = [self._made_here(element) for element in node.elts]
        return node

    def visit_BinOp(self, node: ast.BinOp) -> ast.expr:
        if isinstance(node.op, ast.BitAnd) and any(
            isinstance(operand, ast.Compare) for operand in _operands(node)
        ):
            call = self._call("both", self.visit(node.left), self.visit(node.right))
            return ast.copy_location(call, node)
        if not self.is_derivative or not isinstance(node.op, (ast.Add, ast.Sub)):
            return self.generic_visit(node)
        whole = ast.unparse(node)
        indices = [
            None
            if _has_own_sites(term) and not isinstance(term, ast.Constant)
            else self._site(term, f"term {ast.unparse(term)} of {whole}")
            for term in (node.left, node.right)
        ]
        method = "add" if isinstance(node.op, ast.Add) else "subtract"
        call = self._call(method, *indices, self.visit(node.left), self.visit(node.right))
        return ast.copy_location(call, node)

    def visit_Compare(self, node: ast.Compare, reason: str = "") -> ast.expr:
        if len(node.ops) > 1 or type(node.ops[0]) not in _COMPARISONS:
            return self.generic_visit(node)
        index = self._site(node, comparison=type(node.ops[0]), reason=reason)
        operands = self.visit(node.left), self.visit(node.comparators[0])
        return ast.copy_location(self._call("compare", index, *operands), node)

    def visit_Call(self, node: ast.Call) -> ast.expr:
        name, whole = _called(node), ast.unparse(node)
        if name == "select":
            return self._visit_select(node)
        sites = {"append": [0], "fma": [0, 2]}.get(name, [])
        if name in _HAND_OVERS:
            sites = [len(node.args) - 1]
        node.func = self.visit(node.func)
        for k, argument in enumerate(node.args):
            text = f"term {ast.unparse(argument)} of {whole}" if name == "fma" else whole
            node.args[k] = self._scaled(argument, text) if k in sites else self.visit(argument)
        for keyword in node.keywords:
            text = f"{keyword.arg}={ast.unparse(keyword.value)}"
            keyword.value = self._scaled(keyword.value, text)
        return node

    def _visit_select(self, node: ast.Call) -> ast.expr:
        if not self.is_derivative:
            return self.generic_visit(node)
        whole = ast.unparse(node)
        condition, *branches = node.args
        operands = _operands(condition)
        parts = tuple(ast.unparse(operand) for operand in operands)
        values = {ast.dump(branch) for branch in branches}
        visited = []
        for operand in operands:
            if isinstance(operand, ast.Compare):
                is_same = {ast.dump(operand.left), ast.dump(operand.comparators[0])} == values
                visited.append(self.visit_Compare(operand, SAME_AT_EQUALITY if is_same else ""))
            else:
                visited.append(self.visit(operand))
        index = self._site(node, whole, parts=parts)
        branches = [self.visit(branch) for branch in branches]
        call = self._call("select", index, ast.List(visited, ast.Load()), *branches)
        return ast.copy_location(call, node)


def _called(node: ast.Call) -> str:
    """The name of the function or method that is called."""
    return node.func.attr if isinstance(node.func, ast.Attribute) else ast.unparse(node.func)


def _has_own_sites(node: ast.expr) -> bool:
    """Whether the value is no site: a constant, or its elements, terms or arguments are sites."""
    if isinstance(node, (ast.Constant, ast.Lambda, ast.List, ast.Tuple)):
        return True
    if isinstance(node, ast.ListComp):
        return _has_own_sites(node.elt)
    if isinstance(node, ast.BinOp):
        return isinstance(node.op, (ast.Add, ast.Sub))
    if isinstance(node, ast.Call):
        name = _called(node)
        return name in {"fma", "zeros", "empty"} or bool(node.keywords and not node.args)
    return False


def _operands(condition: ast.expr) -> list[ast.expr]:
    if isinstance(condition, ast.BinOp) and isinstance(condition.op, ast.BitAnd):
        return [*_operands(condition.left), *_operands(condition.right)]
    return [condition]


def _only_evaluated(function: ast.FunctionDef) -> set[str]:
    """Names that are read by ``dr.eval`` and by nothing else."""
    evaluated: set[int] = set()
    for node in ast.walk(function):
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "dr.eval":
            evaluated |= {id(n) for argument in node.args for n in ast.walk(argument)}
    reads = [
        node
        for node in ast.walk(function)
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load)
    ]
    return {n.id for n in reads} - {n.id for n in reads if id(n) not in evaluated}
