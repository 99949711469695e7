"""Copies of a module with one operator of one gradient changed.

Mutants are made from the syntax tree, so that no list of formulas has to be kept: every sign, factor, transpose,
condition and index order in a function whose name says that it is a derivative.
"""

import ast
import copy
import inspect
from types import SimpleNamespace

DERIVATIVES = (
    "_vjp",
    "_gradient",
    "_jacobian",
    "_suffix_sums",
)  # ends of the names of functions that only gradients use
FIRST_OF = {"clip": 0, "sign": 0, "swapaxes": 0, "where": 1, "maximum": 0}  # np.f(...) becomes this argument of it


def mutants(module):
    """Yield (what was changed, copy of the module) for every single change."""
    tree = ast.parse(inspect.getsource(module))
    functions = [n for n in tree.body if isinstance(n, ast.FunctionDef) and n.name.endswith(DERIVATIVES)]
    for function in functions:
        body = function.body
        for k, statement in enumerate(body):
            for path, node in _walk(statement):
                for changed in _changes(node):
                    what = f"{function.name}: {ast.unparse(node)} -> {ast.unparse(changed)}"
                    function.body = [*body[:k], _replaced(statement, path, changed), *body[k + 1 :]]
                    yield what, _executed(tree, module)
        function.body = body


def _executed(tree, module):
    names = {"__name__": module.__name__, "__package__": module.__package__}
    exec(compile(ast.fix_missing_locations(tree), module.__file__, "exec"), names)
    return SimpleNamespace(**names)


def _walk(node, path=()):
    """Every expression below a statement with the way to it; no annotation, subscript or keyword such as axis."""
    if isinstance(node, ast.expr | ast.AugAssign | ast.Assign | ast.Return):
        yield path, node
    for field, value in ast.iter_fields(node):
        if field in ("annotation", "slice", "keywords", "targets", "target", "ctx", "op"):
            continue
        for index, child in enumerate(value) if isinstance(value, list) else [(None, value)]:
            if isinstance(child, ast.AST):
                yield from _walk(child, (*path, (field, index)))


def _replaced(statement, path, changed):
    if not path:
        return changed
    root = copy.deepcopy(statement)
    node = root
    for field, index in path[:-1]:
        node = getattr(node, field) if index is None else getattr(node, field)[index]
    field, index = path[-1]
    if index is None:
        setattr(node, field, changed)
    else:
        getattr(node, field)[index] = changed
    return root


def _changes(node):
    swaps = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.BitAnd: ast.BitOr}
    turns = {ast.Lt: ast.GtE, ast.LtE: ast.Gt, ast.Gt: ast.LtE, ast.GtE: ast.Lt}
    match node:
        case ast.BinOp(left, op, right) if type(op) in swaps:
            yield ast.BinOp(left, swaps[type(op)](), right)
        case ast.AugAssign(target, op, value) if type(op) in swaps:
            yield ast.AugAssign(target, swaps[type(op)](), value)
        case ast.UnaryOp(ast.USub(), operand):
            yield operand
        case ast.Attribute(value, "T"):
            yield value
        case ast.Compare(left, [op], [right]) if type(op) in turns:
            yield ast.Compare(left, [turns[type(op)]()], [right])
        case ast.Call(ast.Attribute(ast.Name("np"), "einsum"), [ast.Constant(text), *operands], keywords):
            for swapped in _swapped_letters(text):
                yield ast.Call(node.func, [ast.Constant(swapped), *operands], keywords)
        case ast.Call(ast.Attribute(ast.Name("np"), name), args) if name in FIRST_OF and len(args) > FIRST_OF[name]:
            yield args[FIRST_OF[name]]
        case ast.Assign(targets, value) if not isinstance(value, ast.Tuple):
            yield from (ast.Assign(targets, half, lineno=0) for (half,) in _halved([value]))
        case ast.Return(value) if not isinstance(value, ast.Tuple):
            yield from (ast.Return(half) for (half,) in _halved([value]))
        case ast.Tuple(elements):
            yield from (ast.Tuple(half, ast.Load()) for half in _halved(elements))
        case ast.Call(ast.Name(), elements, keywords):
            yield from (ast.Call(node.func, half, keywords) for half in _halved(elements))


def _halved(elements):
    """Lists with one element halved, but not zeros, which the spherical harmonics call o."""
    for k, element in enumerate(elements):
        if not ast.unparse(element).startswith("np.zeros") and ast.unparse(element) != "o":
            yield [*elements[:k], ast.BinOp(ast.Constant(0.5), ast.Mult(), element), *elements[k + 1 :]]


def _swapped_letters(text):
    """Index lists with the last two letters of one of them exchanged: one operand, or the result, transposed."""
    for start, letter in enumerate(text[1:]):
        is_last = start + 2 == len(text) or text[start + 2] in ",-"
        if is_last and letter.isalpha() and text[start].isalpha():
            yield text[:start] + letter + text[start] + text[start + 2 :]
