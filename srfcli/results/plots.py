"""Figures in the house style, from plain arrays; matplotlib is imported on use and never opens a window."""

from __future__ import annotations

import contextlib
import importlib.util
import io
import itertools
import logging
import math
import sys
import warnings
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from srfcli.core.errors import SrfError, printable
from srfcli.core.files import check_target
from srfcli.laws.law_file import RESERVED

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.gridspec import SubplotSpec

Values = Collection[Any]  # a list or an array of numbers; None or NaN is a gap

FIGURE_SUFFIXES = (".png", ".svg", ".pdf")

# Okabe and Ito's palette without its yellow, dark enough on white; line styles say the same once more for print.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")
DASHES: tuple[Any, ...] = ("-", (0, (5, 1.5)), (0, (5, 1.5, 1, 1.5)), (0, (9, 2)), (0, (3, 1, 1, 1, 1, 1)), (0, (2, 2)))
DOTTED = (0, (1, 1.2))  # kept for the constant load
# one quantity, one colour, in every figure
QUANTITY = {"u": COLOURS[0], "v": COLOURS[1], "V": COLOURS[6], "mu": COLOURS[2], "W": COLOURS[3], "state": COLOURS[5]}
PLOT_SYMBOLS = {
    "W0": "W$_0$", "V0": "V$_0$", "D0": "D$_0$", "mu0": "µ$_0$", "Vsat": "V$_{sat}$", "Va": "V$_a$", "Vb": "V$_b$", "eps": "ε",
    "lambda": "λ", "alpha": "α", "phi": "φ",
}  # fmt: skip
HEADING, LINE, MARGIN = 9.0, 0.155, 0.012  # points and inches of a heading's line; its margin, of the figure's width
NAME_OFFSET = 9.0  # points of a curve's name below the axes
NAME_ROW, NAME_WIDTH, HANDLE = 0.19, 0.075, 0.65  # inches of a row of names, of a letter, and of the line beside a name
SCREEN = 90.0  # dots per inch in a notebook

STYLE: dict[str, Any] = {
    "figure.figsize": (6.0, 4.2),
    "figure.constrained_layout.use": True,
    "savefig.dpi": 200,
    "font.size": 10.0,
    "font.family": ["DejaVu Sans"],  # comes with matplotlib: the same bytes on every machine
    "mathtext.fontset": "dejavusans",
    "axes.titlesize": 10.5,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#E4E4E4",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "lines.linewidth": 1.6,
    "legend.frameon": False,
    "svg.hashsalt": "srf",
    "pdf.compression": 6,
}

# A figure whose layout is settled has no engine; under this one it is given none by being saved.
NO_LAYOUT = {"figure.constrained_layout.use": False}

# Dates would make two equal figures differ.
_METADATA: dict[str, dict[str, Any]] = {".svg": {"Date": None}, ".pdf": {"CreationDate": None, "ModDate": None}, ".png": {}}


def check_plot(path: Path, *, force: bool) -> None:
    """Raise SrfError where a figure could not be saved at `path`; matplotlib is looked for but not imported."""
    if path.suffix.lower() not in FIGURE_SUFFIXES:
        got = f"ends in {path.suffix!r}" if path.suffix else "has no ending"
        raise SrfError(f"--plot {path} {got}", f"End it in {', '.join(FIGURE_SUFFIXES)}: --plot {path.with_suffix('.svg')}")
    check_target(path, force=force, what="--plot")
    if importlib.util.find_spec("matplotlib") is None:
        raise _missing()


def _missing() -> SrfError:
    return SrfError("a figure needs matplotlib, which is not installed", 'pip install "srfcli[plot]"')


@contextlib.contextmanager
def house_style() -> Iterator[None]:
    """Draw and save with the house's settings, whatever the user's matplotlibrc says."""
    try:
        with contextlib.ExitStack() as stack:
            if "matplotlib" not in sys.modules:  # it reads a `matplotlibrc` in the current folder, which is not trusted
                with contextlib.suppress(OSError):  # a current folder that is gone holds no settings either
                    stack.enter_context(contextlib.chdir(Path(__file__).parent))
            import matplotlib
    except ImportError as error:
        raise _missing() from error
    logging.getLogger("matplotlib.font_manager").setLevel(logging.ERROR)  # cache chatter is not the user's concern
    with matplotlib.rc_context(), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing", UserWarning)  # a name in a script that the font lacks
        matplotlib.rcParams.update({k: v for k, v in matplotlib.rcParamsDefault.items() if not k.startswith("backend")})
        matplotlib.rcParams.update(STYLE)
        yield


def name_text(name: str, *, narrow: bool = False, wide: bool = False) -> str:
    """Return a user's text so that a figure shows it as it is: a dollar sign opens no formula, a line does not break.

    It is cut where it would leave the figure no room, early in one for small screens, late where it may be broken.
    """
    words, most = printable(" ".join(name.split())), 18 if narrow else 160 if wide else 48
    return (words if len(words) <= most else words[: most - 1] + "…").replace("$", r"\$")


_PLACE: ContextVar[Axes | None] = ContextVar("axes in whose place the next figure is drawn", default=None)


def in_place(ax: Axes | None, draw: Callable[[], Figure]) -> Figure:
    """Return the figure of several panels that `draw` makes; drawn in the place of `ax` if that is given, the figure that has it.

    Raises SrfError for an axes that stands in no grid.
    """
    if ax is None:
        return draw()
    if ax.get_subplotspec() is None:
        raise SrfError("an axes that was placed by hand has no room for several panels", "Take one of figure.subplots().")
    figure, place = cast("Figure", ax.figure), _PLACE.set(ax)
    if hasattr(figure, "set_layout_engine") and figure.get_layout_engine() is None:
        figure.set_layout_engine("constrained")  # which gives titles and names of panels room
    try:
        draw()
    finally:
        _PLACE.reset(place)
    return figure


def bare_figure(size: tuple[float, float] | None = None) -> Figure:
    """Return a figure without panels, which a notebook shows even where nobody has imported pyplot; `in_place` a part of one."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    if (ax := _PLACE.get()) is not None:
        part, spec = cast("Figure", ax.figure), cast("SubplotSpec", ax.get_subplotspec())
        ax.remove()
        _PLACE.set(None)
        return cast("Figure", part.add_subfigure(spec))
    figure = Figure(figsize=size)
    FigureCanvasAgg(figure)
    vars(figure)["_repr_png_"] = lambda: figure_bytes(figure, ".png", dpi=SCREEN)
    return figure


def new_figure(rows: int = 1, *, size: tuple[float, float] | None = None) -> tuple[Figure, list[Axes]]:
    """Return a figure of `rows` panels above each other on one x axis; call it, and draw, within `house_style`."""
    figure = bare_figure(size)
    axes = figure.subplots(rows, 1, sharex=True, squeeze=False)
    return figure, [row[0] for row in axes]


def figure_bytes(figure: Figure, suffix: str, *, dpi: float | None = None) -> bytes:
    """Return the figure as a .png, .svg or .pdf file's content; equal figures give equal bytes."""
    from matplotlib import rc_context

    buffer = io.BytesIO()
    with house_style(), rc_context(NO_LAYOUT):
        form, dots = suffix.lstrip(".").lower(), dpi or STYLE["savefig.dpi"]
        figure.savefig(buffer, format=form, metadata=_METADATA[suffix.lower()], dpi=dots)
    return buffer.getvalue()


def symbol_text(name: str) -> str:
    """Return a parameter's name as it is set in a figure: W$_0$ for W0, ε for eps."""
    return PLOT_SYMBOLS.get(name) or name_text(name)


def axis_label(name: str, unit: str) -> str:
    """Return a parameter, or a ratio as K/W0, as the label of an axis, with its unit unless that is 1."""
    text = "/".join(map(symbol_text, name.split("/")))
    return text if unit in ("", "1") else f"{text}  [{unit.replace('um', 'µm')}]"


def curve_style(index: int) -> dict[str, Any]:
    """Return colour and line style of a figure's curve number `index`."""
    return {"color": COLOURS[index % len(COLOURS)], "linestyle": DASHES[index % len(DASHES)]}


def titled(title: str, described: Mapping[str, Mapping[str, Any]]) -> str:
    """Return a figure's title: the laws, and under them every parameter that the axes do not show, apparatus first.

    `described` is as a table's parameters are.
    """
    known = [name for name, p in described.items() if isinstance(p.get("value"), float | int)]
    groups = [[n for n in RESERVED if n in known], [n for n in known if n not in RESERVED]]  # the law's own follow
    lines = [", ".join(valued(n, described[n]["value"], str(described[n].get("unit"))) for n in g) for g in groups]
    return "\n".join(line for line in [title, *lines] if line)


def valued(name: str, value: float, unit: str) -> str:
    """Return a parameter with its value as it is set in a figure: W$_0$ = 10 N."""
    return f"{symbol_text(name)} = {value:.4g}{'' if unit in ('', '1') else f' {unit}'.replace('um', 'µm')}"


def heading(figure: Figure, text: str) -> None:
    """Set a figure's title at its upper left, each line broken between parts where it is wider than the figure.

    The figure grows by what the lines take beyond the first, so that the axes stay as high as they are.
    """
    if not text:
        return
    lines = [broken for line in text.split("\n") for broken in _broken(line, figure, (1 - 2 * MARGIN) * figure.bbox.width)]
    _grow(figure, LINE * len(lines[1:]))
    figure.suptitle("\n".join(lines), x=MARGIN, ha="left", fontsize=HEADING, linespacing=1.3)


def _broken(line: str, figure: Figure, width: float) -> list[str]:
    probe = figure.text(0, 0, "", fontsize=HEADING)
    lines = [""]
    for part in line.split(", "):
        joined = f"{lines[-1]}, {part}" if lines[-1] else part
        probe.set_text(f"{joined},")
        if lines[-1] and probe.get_window_extent().width > width:
            lines[-1] += ","
            lines.append(part)
        else:
            lines[-1] = joined
    probe.remove()
    return lines


def _grow(figure: Figure, inches: float) -> None:
    """Make a figure higher, unless it is a part of somebody's own."""
    if hasattr(figure, "set_figheight"):
        figure.set_figheight(figure.get_figheight() + inches)


def names_below(figure: Figure, handles: Sequence[Any], names: Sequence[str], **more: Any) -> None:
    """Name curves below the axes, where the names cover nothing; the figure grows by their rows."""
    if not names:
        return
    widest = max(len(n.replace("$", "").replace("_", "")) for n in names) * NAME_WIDTH + HANDLE
    columns = max(1, min(len(names), int(figure.bbox.width / figure.dpi / widest)))
    _grow(figure, NAME_ROW * -(-len(names) // columns))
    figure.legend(
        handles, names, loc="outside lower center", ncols=columns, fontsize=NAME_OFFSET,
        **{"handlelength": 2.8, "columnspacing": 1.4, **more},
    )  # fmt: skip


@contextlib.contextmanager
def one_panel(ax: Axes | None, *, title: str, size: tuple[float, float] | None = None) -> Iterator[tuple[Figure, Axes]]:
    """Yield a figure of one panel to draw in, or that of `ax`; then what was drawn is titled and its curves are named.

    In somebody's own axes title and names stay within them.
    """
    with house_style():
        if ax is not None:
            yield cast("Figure", ax.figure), ax
            ax.set_title("\n".join(_broken(title.split("\n")[0], cast("Figure", ax.figure), ax.bbox.width)), fontsize=HEADING)
            if len(ax.get_legend_handles_labels()[1]) > 1:
                ax.legend(loc="best", handlelength=2.8, fontsize=NAME_OFFSET)
            return
        figure, (own,) = new_figure(size=size)
        yield figure, own
        heading(figure, title)
        handles, names = own.get_legend_handles_labels()
        if len(names) > 1:
            names_below(figure, handles, names)


def stability_diagram(
    branches: Sequence[Mapping[str, Any]], *, hopf: Mapping[str, Any] | None = None, title: str = "", ax: Axes | None = None
) -> Figure:
    """Return the stability boundaries K/W0 (1/um) against V (um/s, logarithmic), drawn in `ax` if that is given.

    A branch is {eps, V, K_over_W0, component, label}, of which component and label may be missing; the branches of one
    eps share colour and line style. `hopf`, {V, K_over_W0}, is the boundary under constant load. The curves of a single
    eps are shaded where sliding is stable: at the top, and beyond every second crossing on the way down.
    """
    with one_panel(ax, title=title) as (figure, ax):
        ax.set_xscale("log")
        if hopf is not None:
            ax.plot(hopf["V"], _gaps(hopf["K_over_W0"]), color="#555555", linestyle=DOTTED, label="ε = 0 (Hopf)")
        draw_branches(ax, branches)
        amplitudes = {b["eps"] for b in branches}
        ax.set(xlabel="V  [µm/s]", ylabel="K/W$_0$  [1/µm]")
        ax.margins(x=0.0)  # the x axis ends where the curves end, the y axis begins at 0 and has room above the curves
        ax.autoscale_view()
        low, high = ax.get_ylim()
        ax.set_ylim(min(0.0, low), high + 0.12 * (high - min(0.0, low)))
        if len(amplitudes) == 1 or (hopf is not None and not branches):
            curves = [(b["V"], b["K_over_W0"]) for b in branches] or [(hopf["V"], hopf["K_over_W0"])]  # type: ignore[index]
            _shade_stable(ax, curves, COLOURS[0] if branches else "#555555")
        elif branches:
            folded = any(_folds(b["V"]) for b in branches)
            text = "stable above, and right of a fold" if folded else "stable above each curve"
            ax.annotate(text, (0.99, 0.985), xycoords="axes fraction", ha="right", va="top", color="#555555")
        decade_ticks(ax)
        return figure


def draw_branches(ax: Axes, branches: Sequence[Mapping[str, Any]]) -> None:
    """Draw the branches of a `stability_diagram`, one colour and line style for each eps."""
    order = list(dict.fromkeys(b["eps"] for b in branches))
    named: set[str] = set()
    for branch in branches:
        label = branch.get("label") or f"ε = {branch['eps']:g}"
        ax.plot(
            branch["V"],
            _gaps(branch["K_over_W0"]),
            **curve_style(order.index(branch["eps"])),
            label=label if label not in named else None,
            marker="o" if len(branch["V"]) == 1 else None,
        )
        named.add(label)


def _gaps(values: Values) -> list[float]:
    return [float("nan") if v is None else float(v) for v in values]


def _folds(x: Values) -> bool:
    values = [float(v) for v in x]
    rising = [b > a for a, b in itertools.pairwise(values) if a != b]
    return any(rising) and not all(rising)


def _shade_stable(ax: Axes, curves: Sequence[tuple[Values, Values]], colour: str) -> None:
    """Shade where sliding is stable: from the top down to the first crossing at each x, then between every second pair."""
    import numpy as np

    low, high = ax.get_xlim()
    bottom, top = ax.get_ylim()
    columns = np.geomspace(low, high, 1200)
    place = np.log(columns)
    edges: list[list[float]] = [[] for _ in columns]
    for x, y in curves:
        points = zip(np.log(np.asarray(list(x), float)), _gaps(y), strict=True)
        for (x0, y0), (x1, y1) in itertools.pairwise(points):
            if not math.isfinite(y0 + y1) or x0 == x1:
                continue
            inside = np.flatnonzero((place - x0) * (place - x1) <= 0)
            heights = y0 + (place[inside] - x0) / (x1 - x0) * (y1 - y0)
            for column, height in zip(inside.tolist(), heights.tolist(), strict=True):
                edges[column].append(height)
    covered = np.array([bool(heights) for heights in edges])
    most = max((len(e) for e in edges), default=0)
    levels = np.full((most + 2, columns.size), bottom)
    levels[0] = top
    for j, heights in enumerate(edges):
        levels[1 : len(heights) + 1, j] = sorted(heights, reverse=True)
    from matplotlib.colors import to_rgb

    pale = tuple(1.0 - 0.10 * (1.0 - part) for part in to_rgb(colour))  # opaque: pieces may overlap
    half = np.sqrt(columns[1] / columns[0])
    sides = np.stack([columns / half, columns * half], axis=1).ravel()  # strips that meet, as levels jump at a fold
    for k in range(0, most + 1, 2):
        # where a column has fewer crossings than k the levels coincide, so that nothing is drawn there
        upper, lower = (np.repeat(levels[j], 2) for j in (k, k + 1))
        there = np.repeat(covered, 2) & (upper > lower)
        ax.fill_between(sides, lower, upper, where=there, facecolor=pale, linewidth=0, antialiased=False, zorder=0.2)
    ax.set_xlim(low, high)
    ax.annotate("stable", (0.98, 0.97), xycoords="axes fraction", ha="right", va="top", color="#333333")
    ax.annotate("oscillates", (0.02, 0.03), xycoords="axes fraction", ha="left", va="bottom", color="#333333")


def lines(
    x: Values,
    ys: Sequence[Values],
    labels: Sequence[str],
    xlabel: str,
    ylabel: str,
    logx: bool = False,
    *,
    title: str = "",
    ax: Axes | None = None,
) -> Figure:
    """Return several curves over one x; labels and units are the caller's; NaN or None leaves a gap."""
    with one_panel(ax, title=title) as (figure, ax):
        for index, (y, label) in enumerate(zip(ys, labels, strict=True)):
            drawn = _gaps(y)
            marker = "o" if len(drawn) == 1 else None
            ax.plot(_gaps(x), drawn, **curve_style(index), label=label, marker=marker, markersize=4)
        if logx:
            ax.set_xscale("log")
        ax.margins(x=0.0 if len(x) > 1 else 0.05)
        ax.set(xlabel=xlabel, ylabel=ylabel)
        decade_ticks(ax)
        return figure


def orbit(tau: Values, *, u: Values, v: Values, states: Mapping[str, Values], mu: Values, W: Values, title: str = "") -> Figure:
    """Return one forced period, panels over tau in periods: u (um), v (um/s, logarithmic), ages (s), mu and W (N)."""
    panels: list[tuple[str, Values, bool, str]] = [("u  [µm]", u, False, "u"), ("v  [µm/s]", v, True, "v")]
    panels += [(f"{n.replace('phi', 'φ').replace('_', ' ')}  [s]", ages, True, "state") for n, ages in states.items()]
    panels += [("µ", mu, False, "mu"), ("W  [N]", W, False, "W")]
    with house_style():
        figure, axes = new_figure(len(panels), size=(6.0, 1.15 * len(panels) + 0.9))
        for ax, (label, values, log, quantity) in zip(axes, panels, strict=True):
            ax.plot(list(tau), list(values), color=QUANTITY[quantity])
            positive = [y for y in values if y > 0]
            if log and positive and max(positive) > 3 * min(positive):
                ax.set_yscale("log")
            else:
                ax.ticklabel_format(axis="y", useOffset=False)
            ax.set_ylabel(label)
            ax.margins(x=0.0, y=0.12)
            decade_ticks(ax)
        heading(figure, title)
        axes[-1].set_xlim(0.0, 1.0)
        axes[-1].set_xlabel("time  [periods of the load]")
        figure.align_ylabels(axes)
        return figure


def decade_ticks(ax: Axes) -> None:
    """Write 1, 10, 100 rather than powers of ten on logarithmic axes, and more between where they span few decades."""
    from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter, NullLocator

    across, up = (size / ax.figure.dpi for size in (ax.bbox.width, ax.bbox.height))
    for axis, (low, high), scale, room in (
        (ax.xaxis, ax.get_xlim(), ax.get_xscale(), across / 0.45),
        (ax.yaxis, ax.get_ylim(), ax.get_yscale(), up / 0.2),
    ):
        if scale != "log" or not 1e-4 <= low <= high <= 1e5:
            continue
        ratio = high / low
        between = (1.0,) if ratio >= 2e3 else (1.0, 2.0, 5.0) if ratio > 8 else (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.0)
        if ratio > 30 and len(between) * math.log10(ratio) > room:
            between = (1.0,)
        narrow = ratio < 3  # a few ticks of such a list at best
        axis.set_major_locator(MaxNLocator(6) if narrow else LogLocator(subs=between))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(NullFormatter())
        if narrow:
            axis.set_minor_locator(NullLocator())
