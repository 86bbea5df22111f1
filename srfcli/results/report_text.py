"""Numbers and sentences of the diagnosis' report: sensible digits, declared units, the verdict in plain words."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any, TypeGuard

SMALLEST_P = 1e-290
NO_BREAK = "\u00a0"  # between a number and its unit no line breaks
NO_ERROR = 1e-12  # of a value: an error below it is rounding
PLAIN = (1e-4, 1e6)  # between these a number is written without a power of ten
SUPERSCRIPT = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")


def finite(value: Any) -> TypeGuard[float]:
    """Return whether `value` is a number that is neither infinite nor NaN."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def number(value: Any, digits: int = 3) -> str:
    """Return a number with so many significant digits, or a dash where there is none."""
    if not finite(value):
        return "–"
    if value == 0:
        return "0"
    rounded = float(f"{value:.{digits}g}")
    power = math.floor(math.log10(abs(rounded)))
    if not PLAIN[0] <= abs(rounded) < PLAIN[1]:
        return _minus(f"{rounded / 10.0**power:.{digits - 1}f}" + f"·10{str(power).translate(SUPERSCRIPT)}")
    return _minus(f"{rounded:.{max(digits - 1 - power, 0)}f}")


def format_with_error(value: Any, error: Any) -> str:
    """Return `value ± error` with two digits of the error, the value to the same place."""
    if not finite(value):
        return "–"
    if not finite(error) or error <= 0:
        return number(value, 4)
    place = math.floor(math.log10(float(f"{error:.1e}"))) - 1  # of the error's second digit
    size = max(abs(value), error)
    if PLAIN[0] <= size < PLAIN[1] or (abs(value) < error and error >= 1e-6):
        decimals = max(-place, 0)
        return _minus(f"{round(value, -place):.{decimals}f} ± {round(error, -place):.{decimals}f}")
    power = math.floor(math.log10(size))
    decimals = max(power - place, 0)
    scaled = f"({value / 10.0**power:.{decimals}f} ± {error / 10.0**power:.{decimals}f})"
    return _minus(f"{scaled}·10{str(power).translate(SUPERSCRIPT)}")


def probability(value: Any) -> str:
    """Return a p-value: three decimals where it is large, one digit and a power of ten where it is not."""
    if not finite(value):
        return "–"
    if value < SMALLEST_P:
        return "< 10⁻²⁹⁰"
    return f"{value:.3f}" if value >= 0.001 else number(value, 1)


def percent(share: Any) -> str:
    """Return a share as a percentage, with more digits near 0 and 100 %."""
    if not finite(share):
        return "–"
    value = 100.0 * share
    if 0 < value < 0.01:
        return f"< 0.01{NO_BREAK}%"
    if value == 0 or abs(value) >= 10:
        return f"{_minus(f'{value:.0f}' if value <= 99.5 or value == 100 else f'{value:.1f}')}{NO_BREAK}%"
    return f"{number(value, 2 if abs(value) >= 1 else 1)}{NO_BREAK}%"


def rms(value: Any) -> str:
    """Return innovations in units of the noise: two decimals, fewer where they are large."""
    if not finite(value):
        return "–"
    return f"{value:.2f}" if value < 9.995 else number(value, 3)


def unit_text(unit: Any) -> str:
    """Return a unit as it is printed, nothing for 1."""
    return "" if unit in (None, "", "1") else str(unit).replace("um", "µm")


def with_unit(text: str, unit: Any) -> str:
    """Return a number's text with its unit, from which no line break parts it; as it is for the unit 1."""
    shown = unit_text(unit)
    return f"{text}{NO_BREAK}{shown}" if shown else text


def spans(windows: Sequence[Sequence[float]], most: int = 4) -> str:
    """Return intervals of time in words, the first `most` of them."""
    shown = [f"{number(a)} to {number(b)}{NO_BREAK}s" for a, b in windows[:most]]
    more = len(windows) - len(shown)
    return joined([*shown, f"{more} more"] if more > 0 else shown)


def joined(words: Sequence[str], last: str = "and") -> str:
    """Return words as a list in a sentence."""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} {last} {words[-1]}" if words else ""


def verdict_sentence(answer: Mapping[str, Any], material: Mapping[str, Any]) -> str:
    """Return what is wrong and how much, in one sentence that needs no other."""
    effects = [str(e) for e in answer.get("effects", ())]
    verdict = answer.get("verdict")
    if verdict == "none":
        return "Nothing is missing: the model explains the recordings down to the noise."
    if verdict == "identified":
        alone = answer.get("acts_in") or {}
        told = [_wrong(e, material) + (f", in the run {alone[e]} alone" if e in alone else "") for e in effects]
        return " ".join(_capital(text) + "." for text in told)
    if verdict == "ambiguous":
        return f"Something is missing, and these recordings cannot tell which of {joined(effects, 'or')} it is."
    if verdict == "unknown":
        return "Something is missing that no registered effect explains."
    if verdict == "inconclusive":
        return "Nothing has to be added, but this experiment could not have seen most effects of a size that matters."
    return f"The verdict is {verdict}."


def remedy(answer: Mapping[str, Any], material: Mapping[str, Any]) -> str:
    """Return what to do about it, in a sentence or two."""
    effects, verdict = [str(e) for e in answer.get("effects", ())], answer.get("verdict")
    if verdict == "none":
        return "Continue with the parameters below; a fit with held-out runs shows how far they carry."
    if verdict == "identified":
        told = [text for e in effects if (text := _filled("remedy", e, material))]
        rest = "continue with the augmented model, in the folder augmented beside this page"
        return _capital("; ".join([*told, rest])) + "."
    if verdict == "ambiguous":
        if material.get("discriminating"):
            return "Make the experiment described below: the candidates predict different records of it."
        return "Vary in another run what these runs have in common: the load, the velocity or the stiffness."
    if verdict == "unknown":
        form = (material.get("force") or {}).get("form")
        tail = f" Its best closed form so far is {form}." if form else ""
        return f"Look at the missing force below, against time and against the state, for what it goes with.{tail}"
    return "Vary the load, or record more or with less noise: the sizes that could have been seen are listed below."


def gain_sentence(answer: Mapping[str, Any], material: Mapping[str, Any]) -> str:
    """Return what is gained by the better model, and on what that rests."""
    verdict = answer.get("verdict")
    track = _friction_field(answer)
    if verdict in ("none", "inconclusive"):
        level = _level(answer, material, "baseline")
        return f"With the model as it is{level}{f'; {track}' if track else ''}." if level else ""
    ranked = [r for r in material.get("ranked", ()) if finite(r.get("evidence"))]
    zero = next((r["evidence"] for r in ranked if r.get("name") == "none"), None)
    told = next((r for r in ranked if r.get("told")), None) if verdict == "identified" else None
    parts = [f"{'With the best that was tried, ' if verdict in ('unknown', 'ambiguous') else ''}{_fell(answer, material)}"]
    if told and zero is not None and told["evidence"] > zero:
        parts.append(f"the log evidence rises by {number(told['evidence'] - zero)}")
    parts += [track] if track else []
    if told and finite(told.get("confidence")):
        parts.append(f"confidence {percent(told['confidence'])}")
    runs = len([r for r in material.get("runs", ()) if not r.get("holdout")])
    located = [r for r in (answer.get("location") or {}).get("runs", ()) if finite(r.get("share"))]
    rests = f"It rests on {runs} fitted run{'s' if runs != 1 else ''}" if runs else ""
    if rests and located:
        worst = max(located, key=lambda r: r["share"])
        rests += f", most on “{worst['name']}” ({percent(worst['share'])} of what noise does not explain)"
    return _capital("; ".join(parts)) + "." + (f" {rests}." if rests else "")


def _wrong(effect: str, material: Mapping[str, Any]) -> str:
    if told := _filled("wrong", effect, material):
        return told
    if effect in material.get("laws", ()):
        return f"the ageing law is {effect}, not {material['stated']['ageing']}"
    sizes = joined([f"{p['name']} = {_size(p)}" for p in _rows(effect, material)])
    about = _about(effect, material)
    return f"the model lacks {effect}{f' ({about})' if about else ''}" + (f": {sizes}" if sizes else "")


def _filled(key: str, effect: str, material: Mapping[str, Any]) -> str:
    """Return what an effect's file says is wrong, or to do, with the sizes that were found; "" where it says nothing."""
    rows = _rows(effect, material)
    first = rows[0] if rows else {}
    said = {
        "value": joined([f"{p['name']} = {_size(p)}" for p in rows]) or "its size is below",
        "size": _size(first) if rows else "its size is below",
        "number": with_unit(number(first.get("augmented"), 4), first.get("unit")),
        "stated": str(material.get("stated", {}).get("stiffness", "–")),
    }
    text = str(((material.get("texts") or {}).get(effect) or {}).get(key, ""))
    return re.sub(r"\{(\w+)\}", lambda m: said.get(m[1], m[0]), text)


def _size(row: Mapping[str, Any]) -> str:
    """Return a parameter's value in the augmented model, with its error and unit."""
    return with_unit(bracketed(row.get("augmented"), row.get("augmented_stderr")), row.get("unit"))


def _rows(effect: str, material: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Return the parameters that an effect has and the baseline has not."""
    names = [str(n) for n in (material.get("own") or {}).get(effect, ())]
    rows = [p for p in material.get("parameters", ()) if p.get("name") in names] if names else []
    return rows or [p for p in material.get("parameters", ()) if p.get("baseline") is None and finite(p.get("augmented"))]


def bracketed(value: Any, error: Any) -> str:
    """Return `0.00653(5)`: a value to the last digit of its error, which stands in brackets with one digit, two below 3."""
    if not finite(value):
        return "–"
    if not finite(error) or error <= 0:
        return number(value, 4)
    if error < NO_ERROR * abs(value):
        return number(value, 6)
    digits = 2 if int(f"{error:.0e}"[0]) < 3 else 1
    place = math.floor(math.log10(float(f"{error:.{digits - 1}e}"))) - digits + 1
    size = max(abs(value), error)
    power = 0 if PLAIN[0] <= size < PLAIN[1] else math.floor(math.log10(size))
    decimals = max(power - place, 0)
    shown = round(error / 10.0 ** min(place, power)) if place <= power else round(error)
    if place > 0 and power == 0:
        shown = round(error / 10.0**place) * 10**place
    text = f"{value / 10.0**power:.{decimals}f}({shown})"
    return _minus(text + (f"·10{str(power).translate(SUPERSCRIPT)}" if power else ""))


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def _about(effect: str, material: Mapping[str, Any]) -> str:
    text = str(material.get("about", {}).get(effect, "")).rstrip(".")
    return text[:1].lower() + text[1:] if text[1:2].islower() else text


def _left(material: Mapping[str, Any]) -> str:
    """Return what a model leaves: of recordings innovations, of critical loads residuals."""
    return "innovations" if material.get("runs") or not material.get("thresholds") else "residuals"


def _level(answer: Mapping[str, Any], material: Mapping[str, Any], key: str) -> str:
    fit, held = (rms_of(answer, key, part) for part in ("fit", "holdout"))
    if fit is None:
        return ""
    held_out = f", {rms(held)} times in the held-out ones" if held is not None else ""
    return f" {_left(material)} are {rms(fit)} times the noise in the fitted runs{held_out}"


def _fell(answer: Mapping[str, Any], material: Mapping[str, Any]) -> str:
    before, after = rms_of(answer, "baseline", "fit"), rms_of(answer, "augmented", "fit")
    if before is None or after is None:
        return f"the {_left(material)} change as shown below"
    text = f"{_left(material)} {_changed(before, after)} times the noise in the fitted runs"
    held = rms_of(answer, "baseline", "holdout"), rms_of(answer, "augmented", "holdout")
    if held[0] is None or held[1] is None:
        return text
    return f"{text}, and {_changed(held[0], held[1])} times in runs that the fit never saw"


def _changed(before: float, after: float) -> str:
    """Return `fall from 1.20 to 1.00`, or `stay at 1.00` where both read alike."""
    if rms(before) == rms(after):
        return f"stay at {rms(after)}"
    return f"{'fall' if after < before else 'rise'} from {rms(before)} to {rms(after)}"


def _friction_field(answer: Mapping[str, Any]) -> str:
    """Return how the amplitude of the friction field changes; nothing where neither model needs one."""
    if any("field" not in (answer.get(side) or {}) for side in ("baseline", "augmented")):
        return ""
    before, after = ((answer[side]["field"] or {}).get("amplitude", 0.0) for side in ("baseline", "augmented"))
    if not (before or after):
        return ""
    if before == after:
        return f"the amplitude of its friction field is {number(before, 2)}"
    said = [number(x, 2) if x else "nothing" for x in (before, after)]
    return f"the amplitude of the friction field goes from {said[0]} to {said[1]}"


def definitions(material: Mapping[str, Any]) -> str:
    """Return what innovations, the friction field and the missing force are; nothing where no recording was fitted."""
    if not material.get("runs"):
        return ""
    told = [
        "An innovation is a reading less its prediction from the readings before it; the noise is its standard deviation.",
        "The friction field is a random variation of mu0 along slip that a model needs beside its laws.",
    ]
    if material.get("force"):
        told.append("The missing force is the friction field as the smoother estimates it from all readings, over the load.")
    return " ".join(told)


def rms_of(answer: Mapping[str, Any], model: str, part: str) -> float | None:
    """Return rms over noise of "baseline" or "augmented" in "fit" or "holdout", None where the answer has none."""
    value = ((answer.get(model) or {}).get(part) or {}).get("rms_over_noise")
    return float(value) if finite(value) else None


def _minus(text: str) -> str:
    return text.replace("-", "−")
