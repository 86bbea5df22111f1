"""Formulas: text to sympy through a whitelist, and sympy to text, LaTeX, Python and NumPy."""

from __future__ import annotations

import ast
import keyword
import math
import re
from collections.abc import Callable, Iterable
from typing import Any, NoReturn

import sympy as sp
from sympy.printing.numpy import NumPyPrinter
from sympy.printing.pretty.pretty import PrettyPrinter
from sympy.printing.str import StrPrinter

from srfcli.core.errors import ExpressionError, SrfError, did_you_mean

# Text to sympy through a whitelist of `ast` nodes: nothing that a user writes is ever evaluated as Python.

MAX_CHARS = 2000
MAX_TOKENS = 500
MAX_DEPTH = 30
MAX_DIGITS = 40
MAX_DECIMAL_EXPONENT = 100
MAX_POWER = 512
MAX_BITS = 2048
MAX_ROOT = 1000
MAX_PLAIN = 100
MAX_NAME = 32


class _Whole(sp.Function):
    """A function that is kept whole, so that generated code calls NumPy's; `plain` is the one that it is written out by."""

    nargs = 1

    @classmethod
    def eval(cls, arg: sp.Expr) -> sp.Expr | None:
        """Fold the argument 0 and nothing else."""
        return sp.S.Zero if arg.is_zero else None

    def _eval_evalf(self, prec: int) -> sp.Expr:
        return self.rewrite(self.plain)._eval_evalf(prec)


class log1p(_Whole):  # small letters: the name is that in generated code
    """log(1 + x)."""

    plain = sp.log

    def fdiff(self, argindex: int = 1) -> sp.Expr:
        return 1 / (1 + self.args[0])

    def _eval_rewrite_as_log(self, arg: sp.Expr, **_kwargs: Any) -> sp.Expr:
        return sp.log(1 + arg)

    def _eval_is_real(self) -> bool | None:
        return (1 + self.args[0]).is_positive or None


class expm1(_Whole):
    """exp(x) - 1."""

    plain = sp.exp

    def fdiff(self, argindex: int = 1) -> sp.Expr:
        return sp.exp(self.args[0])

    def _eval_rewrite_as_exp(self, arg: sp.Expr, **_kwargs: Any) -> sp.Expr:
        return sp.exp(arg) - 1

    def _eval_is_real(self) -> bool | None:
        return self.args[0].is_real


# abs, min, max, floor are left out: a law must have derivatives, and complex-step must find them.
_NAMED = (
    sp.exp, sp.log, log1p, expm1, sp.sqrt, sp.sin, sp.cos, sp.sinh, sp.cosh, sp.tanh, sp.asinh, sp.atan, sp.LambertW,
)  # fmt: skip
FUNCTIONS: dict[str, Callable[..., Any]] = {f.__name__: f for f in _NAMED} | {"ln": sp.log, "lambertw": sp.LambertW}
_SMOOTH = "A formula has derivatives everywhere: tanh, sqrt and exp take its place."
INSTEAD = {  # functions that a formula has not -> what to write
    "log10": "Write log(x)/log(10).", "log2": "Write log(x)/log(2).", **dict.fromkeys(("abs", "sign", "min", "max"), _SMOOTH)
}  # fmt: skip
_HYPERBOLIC = frozenset({"sinh", "cosh", "tanh", "asinh", "atan"})
# Names that generated modules use themselves; a parameter of that name would shadow them.
RESERVED = frozenset({"np", "numpy", "x", "t", "tau", "p", "out", "pi", "tan", "arctan", "arcsinh", *FUNCTIONS})

_IDENTIFIER = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
_TOKEN = re.compile(
    r"(?P<space>\s+)|(?P<name>[A-Za-z_][A-Za-z0-9_]*)|(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)"
    r"|(?P<op>\*\*|/(?!/)|[-+*(),])",
    re.ASCII,
)
_ADVICE = {
    "^": "Use '**' for powers",
    "=": "Write the right-hand side only",
    "//": "Use '/'",
    "[": "Use round brackets",
    "{": "Use round brackets",
    "·": "Use '*'",
    "×": "Use '*'",
}
_LANGUAGE = "A formula has numbers, names, + - * / **, round brackets and the functions " + ", ".join(sorted(FUNCTIONS))


def symbol(name: str) -> sp.Symbol:
    """Return the symbol of that name with the assumptions all modules share: it is real."""
    return sp.Symbol(name, real=True)


def check_identifier(name: str, what: str = "name", *, taken: Iterable[str] = ()) -> str:
    """Return `name` if it can become a name in generated code, else raise `SrfError`; `taken` are names in use."""
    if not _IDENTIFIER.fullmatch(name):
        raise SrfError(f"{what} {name!r} is not a name", "Start with a letter; go on with letters, digits, '_'.")
    if "__" in name or name.endswith("_"):  # generated code writes lambda_ for lambda
        raise SrfError(f"{what} {name!r} holds a double or final underscore", "Use single underscores inside.")
    if len(name) > MAX_NAME:
        raise SrfError(f"{what} {name[:MAX_NAME] + '...'!r} is longer than {MAX_NAME} letters", "Shorten it.")
    if name in RESERVED:
        raise SrfError(f"{what} {name!r} is reserved for generated code", f"Reserved: {', '.join(sorted(RESERVED))}.")
    if name in set(taken):
        raise SrfError(f"{what} {name!r} already has a meaning here", "Choose another name.")
    return name


def parse_expression(text: str, known: Iterable[str]) -> sp.Expr:
    """Return the formula `text` in symbols of the names `known`; decimals become exact rationals.

    Raises `ExpressionError` with the place of the fault for anything that is not such a formula; the size of the text
    and of every constant is bounded before it is computed. `log(1 + x)` stays as written.
    """
    if len(text) > MAX_CHARS:
        raise ExpressionError(f"the formula has {len(text)} characters, at most {MAX_CHARS} are read", text="")
    reader = _Reader(text, known)
    try:
        return reader.read()
    except RecursionError:
        raise ExpressionError("the formula is nested too deeply", "Split it up.", text=text) from None
    except (ArithmeticError, TypeError, ValueError, NotImplementedError) as error:  # sympy on constants without sense
        raise ExpressionError(f"the formula cannot be computed: {error}", text=text) from None


class _Reader:
    """One formula on its way from text to sympy."""

    def __init__(self, text: str, known: Iterable[str]) -> None:
        self.text = text
        self.known = frozenset(known)
        self.at: dict[int, str] = {}  # column -> name or number as written; Python never sees either

    def fail(self, message: str, column: int | None, hint: str | None = None) -> NoReturn:
        raise ExpressionError(message, hint, text=re.sub(r"\s", " ", self.text), column=column)

    def read(self) -> sp.Expr:
        code = self.tokenise()
        lead = len(code) - len(code.lstrip())
        try:
            tree = ast.parse(code.lstrip(), mode="eval")
        except (SyntaxError, ValueError, MemoryError) as error:
            end = len(code.rstrip())
            column = end if code[end - 1] in "+-*/" else min(lead + (getattr(error, "offset", None) or 1) - 1, end)
            self.fail("the formula breaks off or has an operator too many", column)
        for node in ast.walk(tree.body):
            if hasattr(node, "col_offset"):
                node.col_offset += lead
        result = self.build(tree.body, 0)
        if result.has(sp.Abs, sp.sign, sp.re, sp.im, sp.arg, sp.I, sp.nan, sp.zoo, sp.oo):
            self.fail("the formula is not smooth and real: it reduces to " + str(result)[:80], None)
        return result

    def tokenise(self) -> str:
        """Return the text with each name and number replaced by one of equal length that Python can read.

        Names become a, aa, aaa..., so that `lambda` and other Python keywords are names like any other; what was
        written is found again by its column.
        """
        code: list[str] = []
        position, count, before = 0, 0, "op"
        while position < len(self.text):
            match = _TOKEN.match(self.text, position)
            if match is None:
                self.unreadable(position)
            kind, word = str(match.lastgroup), match.group()
            if kind != "space":
                count += 1
                opens_value = kind != "op" or (word == "(" and before != "name")
                if before != "op" and opens_value:
                    self.fail("an operator is missing here", position, "Write products with '*'.")
                before = "value" if word == ")" else kind
            if kind in ("name", "number"):
                self.at[position] = word
            code.append({"space": " ", "name": "a", "number": "1", "op": word}[kind])
            code.append(("a" if kind == "name" else " ") * (len(word) - 1 if kind != "op" else 0))
            position = match.end()
        if count > MAX_TOKENS:
            self.fail(f"the formula has {count} words and signs, at most {MAX_TOKENS} are read", None, "Split it up.")
        if count == 0:
            self.fail("the formula is empty", 0)
        self.balance("".join(code))
        return "".join(code)

    def balance(self, code: str) -> None:
        """Refuse brackets that do not match or nest too deeply."""
        opened: list[int] = []
        for position, sign in enumerate(code):
            if sign == "(":
                opened.append(position)
                if len(opened) > MAX_DEPTH:
                    self.fail(f"brackets are nested more than {MAX_DEPTH} deep", position)
            elif sign == ")":
                if not opened:
                    self.fail("this bracket closes nothing", position)
                opened.pop()
        if opened:
            self.fail("this bracket is never closed", opened[-1])

    def unreadable(self, position: int) -> NoReturn:
        sign = next((s for s in _ADVICE if self.text.startswith(s, position)), self.text[position])
        hint = _ADVICE.get(sign)
        self.fail(f"{sign!r} is not part of a formula", position, hint + "." if hint else _LANGUAGE + ".")

    def build(self, node: ast.AST, depth: int) -> sp.Expr:
        column = getattr(node, "col_offset", None)
        if depth > MAX_DEPTH:
            self.fail(f"the formula is nested more than {MAX_DEPTH} deep", column, "Use brackets sparingly or split.")
        match node:
            case ast.Constant():
                return self.number(self.at[node.col_offset], node.col_offset)
            case ast.Name():
                return self.name(self.at[node.col_offset], node.col_offset)
            case ast.UnaryOp(op=ast.USub()):
                return -self.build(node.operand, depth + 1)
            case ast.UnaryOp(op=ast.UAdd()):
                return self.build(node.operand, depth + 1)
            case ast.BinOp():
                left, right = self.build(node.left, depth), self.build(node.right, depth + 1)
                return self.checked(self.binary(node, left, right), node.right.col_offset)
            case ast.Call(func=ast.Name(), keywords=[]):
                return self.call(node, depth)
        self.fail("this is not part of a formula", column, _LANGUAGE + ".")

    def number(self, word: str, column: int) -> sp.Expr:
        mantissa, _, exponent = word.lower().partition("e")
        if sum(c.isdigit() for c in mantissa) > MAX_DIGITS:
            self.fail(f"the number has more than {MAX_DIGITS} digits", column)
        if exponent and (len(exponent) > 6 or abs(int(exponent)) > MAX_DECIMAL_EXPONENT):
            self.fail(f"the exponent of the number is beyond {MAX_DECIMAL_EXPONENT}", column)
        whole, _, part = mantissa.partition(".")
        scale = int(exponent or "0") - len(part)
        digits = sp.Integer(int((whole + part) or "0"))
        return digits * sp.Integer(10) ** scale

    def name(self, word: str, column: int) -> sp.Expr:
        if word in self.known:
            return symbol(word)
        if word in FUNCTIONS:
            self.fail(f"the function '{word}' needs an argument in brackets", column, f"Write {word}(...).")
        self.fail(f"unknown name '{word}'", column, did_you_mean(word, self.known))

    def binary(self, node: ast.BinOp, left: sp.Expr, right: sp.Expr) -> sp.Expr:
        match node.op:
            case ast.Add():
                return left + right
            case ast.Sub():
                return left - right
            case ast.Mult():
                return left * right
            case ast.Div():
                if right.is_zero:
                    self.fail("this constant is zero", node.right.col_offset)
                return left / right
            case ast.Pow():
                self.bound_power(left, right, node.right.col_offset)
                if left.is_zero and not right.is_positive:
                    self.fail("this is a power of zero", node.col_offset)
                return left**right
        self.fail("this operator is not part of a formula", node.col_offset, _LANGUAGE + ".")

    def bound_power(self, base: sp.Expr, exponent: sp.Expr, column: int) -> None:
        """Refuse a power whose exact constants would outgrow `MAX_BITS`, before it is computed.

        sympy distributes (2 x)**n and joins (x**m)**n, so the constants inside a symbolic base count too.
        """
        size = max((abs(n) for n in exponent.atoms(sp.Rational)), default=sp.S.One)
        root = max((n.q for n in exponent.atoms(sp.Rational)), default=1)
        if exponent.is_Rational and size > MAX_POWER:
            self.fail(f"the exponent is beyond {MAX_POWER}", column)
        if _bits(base) and root > MAX_ROOT:  # 9**(1e-9) is a root of degree 1e9 to sympy
            self.fail("the exponent of this constant has too many decimals", column, "Make it a parameter.")
        if _bits(base) * max(size, sp.S.One) > MAX_BITS or _bits(exponent) > MAX_BITS:
            self.fail("the constants of this power are too large to compute exactly", column)

    def call(self, node: ast.Call, depth: int) -> sp.Expr:
        assert isinstance(node.func, ast.Name)
        word, column = self.at[node.func.col_offset], node.func.col_offset
        if word not in FUNCTIONS:
            if word in self.known:
                self.fail(f"'{word}' is not a function", column, f"For a product write {word}*(...).")
            self.fail(f"unknown function '{word}'", column, INSTEAD.get(word) or did_you_mean(word, FUNCTIONS))
        if len(node.args) != 1 or isinstance(node.args[0], ast.Starred):
            self.fail(f"'{word}' takes one argument, here are {len(node.args)}", column)
        argument = self.build(node.args[0], depth + 1)
        if word == "exp" and argument.has(sp.log):  # exp(n log 9) is 9**n to sympy
            self.bound_power(argument, argument, column)
        if argument.is_number and abs(_value(argument)) > 700:
            self.fail(f"the constant argument of '{word}' is out of range", column)
        # sympy may ponder the sign of log(cosh(9) - ...) for long
        if argument.is_number and argument.has(sp.Function):
            self.fail(f"'{word}' is taken of a constant that holds a function", column, "Write the number.")
        # where sympy does not know a power to be real it divides polynomials of the degree of its exponents
        long = any(abs(n.p) > MAX_PLAIN or n.q > MAX_PLAIN for n in argument.atoms(sp.Rational))
        if word in _HYPERBOLIC and argument.is_real is None and long:
            self.fail(f"the constants in the argument of '{word}' are too long", column, "Make them parameters.")
        return self.checked(FUNCTIONS[word](argument), column)

    def checked(self, result: sp.Expr, column: int) -> sp.Expr:
        """Return `result` unless it is a constant that is not a finite real number."""
        if result in (sp.zoo, sp.nan, sp.oo, -sp.oo):
            self.fail("this constant is not a finite number", column)
        if result.is_number and (not math.isfinite(_value(result)) or result.is_real is False):
            self.fail("this constant is not a finite real number", column)
        return result


def _bits(expr: sp.Expr) -> int:
    return sum(int(n.p).bit_length() + int(n.q).bit_length() - 1 for n in expr.atoms(sp.Rational) if abs(n) != 1)


def _value(expr: sp.Expr) -> float:
    """Return a constant as a float, nan where it is not one."""
    try:
        return float(expr)
    except (TypeError, ValueError, OverflowError):
        return math.nan


# Formulas as text, LaTeX and Python, in the field's letters.

_NAMES = {
    "W_dot": r"\dot{W}",
    "mu_dot": r"\dot{\mu}",
    "F_dot_over_W": r"\dot{F}/W",
    "mu_v": r"\mu_v",
    "mu_phi": r"\mu_\phi",
    "kappa_W": r"\kappa_W",
    "Omega_c": r"\Omega_c",
    "eps": r"\epsilon",
    "angle": r"\theta",
    "phi": r"\phi",
}
_GREEK = (
    "alpha", "beta", "gamma", "delta", "epsilon", "eta", "kappa", "lambda", "mu", "phi", "rho", "sigma", "tau", "theta",
)  # fmt: skip


class _Text(StrPrinter):
    """Sympy's plain text with i for the imaginary unit."""

    def _print_ImaginaryUnit(self, expr: sp.Expr) -> str:
        return "i"


def latex_name(name: str) -> str:
    r"""Return a name in LaTeX: Vsat is V_{sat}, D0 is D_0, mu_phi is \mu_\phi; a final ' stays."""
    bare = name.rstrip("'")
    primes = name[len(bare) :]
    if bare in _NAMES:
        return _NAMES[bare] + primes
    match = re.fullmatch("(" + "|".join(_GREEK) + r"|[A-Za-z])_?([A-Za-z0-9]*)", bare)
    if match is None:
        match = re.fullmatch(r"([A-Za-z])([A-Za-z0-9_]*)", bare)
    if match is None:
        return r"\mathrm{" + bare.replace("_", r"\_") + "}" + primes
    head, tail = match.groups()
    letter = f"\\{head}" if head in _GREEK else head
    tail = tail.replace("_", r"\_")
    if not tail:
        return letter + primes
    return f"{letter}_{{{tail}}}{primes}" if len(tail) > 1 else f"{letter}_{tail}{primes}"


def latex(expression: sp.Expr) -> str:
    """Return a formula in LaTeX."""
    plain = _spelled(expression)
    names = {s: latex_name(s.name) for s in sorted(plain.free_symbols, key=str)}
    return sp.latex(plain, symbol_names=names, ln_notation=True)


def text(expression: sp.Expr) -> str:
    """Return a formula on one line of plain text, i the imaginary unit; the expression language reads it where it is real."""
    return _Text().doprint(expression)


def pretty(name: str, expression: sp.Expr) -> str:
    """Return `name` = formula over several lines in Unicode."""
    form = PrettyPrinter({"use_unicode": True, "wrap_line": False})._print(_spelled(expression))
    head = f"{name} = "
    lines = str(form).split("\n")
    return "\n".join(((head if i == form.baseline else " " * len(head)) + line).rstrip() for i, line in enumerate(lines))


def _spelled(expression: sp.Expr) -> sp.Expr:
    """Return `expression` with log1p and expm1 written out."""
    return expression.replace(log1p, lambda a: sp.log(1 + a)).replace(expm1, lambda a: sp.exp(a) - 1)


# Sympy expressions as NumPy source: small powers as products, Python's keywords renamed.

NUMPY_FUNCTIONS = (
    "arcsinh", "arctan", "cos", "cosh", "exp", "expm1", "log", "log1p", "pi", "sin", "sinh", "sqrt", "tan", "tanh",
)  # fmt: skip


class NumPyText(NumPyPrinter):
    """NumPy source with products in place of small integer powers, which NumPy computes by pow()."""

    def __init__(self) -> None:
        super().__init__({"fully_qualified_modules": False, "allow_unknown_functions": True})

    def _print_Pow(self, expr: sp.Pow, rational: bool = False, sqrt: str = "sqrt") -> str:
        base, exponent = expr.as_base_exp()
        if exponent.is_Integer and 2 <= abs(int(exponent)) <= 4:
            inner = self.parenthesize(base, 60)
            product = "*".join([inner] * abs(int(exponent)))
            return f"({product})" if exponent > 0 else f"(1/({product}))"
        if exponent == -1:
            return f"(1/{self.parenthesize(base, 60)})"
        if exponent == sp.S.Half:
            return f"sqrt({self._print(base)})"
        return f"{self.parenthesize(base, 60)}**{self.parenthesize(exponent, 60)}"

    def _print_called(self, expr: sp.Expr) -> str:
        return f"{type(expr).__name__.lower()}({self._print(expr.args[0])})"

    _print_log1p = _print_expm1 = _print_LambertW = _print_called

    def _print_lut(self, expr: sp.Expr) -> str:
        number, argument = expr.args
        return f"{type(expr).__name__}(p, {int(number)}, {self._print(argument)})"

    _print_lut1 = _print_lut2 = _print_lut

    def _print_Pi(self, expr: sp.Expr) -> str:
        return "pi"


def python_name(name: str) -> str:
    """Return `name` as it is written in generated code: `lambda` becomes `lambda_`."""
    return f"{name}_" if keyword.iskeyword(name) else name


def renamed(expression: sp.Expr) -> sp.Expr:
    """Return `expression` with its symbols named as generated code names them."""
    names = {s: sp.Symbol(python_name(s.name)) for s in expression.free_symbols if python_name(s.name) != s.name}
    return expression.xreplace(names)


def numpy_text(expression: sp.Expr) -> str:
    """Return `expression` as generated code writes it."""
    return NumPyText().doprint(renamed(expression))
