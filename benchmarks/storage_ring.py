"""One-turn maps of storage rings, learned from a tracking code (PyAT) and compared with it.

    python -m pip install '.[accelerator]'
    python benchmarks/storage_ring.py            every piece that has no result yet (half an hour)
    python benchmarks/storage_ring.py --quick    a small one

The lattices are those that PyAT ships: `err.mat`, a whole ring with errors, and `hmba.mat`, a cell
of ESRF-EBS. States are (x, y, p_x, p_y) about the closed orbit, in metres and radians, four
dimensional: the energy deviation δ of a particle does not change; it is 0, or a parameter of the
map. Pairs are drawn from an ellipsoid whose half axes are amplitudes of 2 mm in x and in y at the
point where a turn begins.
"""

from __future__ import annotations

from harness import TABLES, between_markers, main, markdown, number, provenance, results
from rings.deviation import deviation, sectors, small_deviation
from rings.figures import maps_of_frequencies, tunes_and_aperture
from rings.frequencies import REGION, frequencies
from rings.many_turns import aperture, long
from rings.tunes import tunes
from rings.turn import turn

PIECES = {
    "turn": turn,
    "tunes": tunes,
    "long": long,
    "aperture": aperture,
    "deviation": deviation,
    "small-deviation": small_deviation,
    "deviation-sectors": sectors,
    "frequencies": frequencies,
}
OF_DELTA = ("deviation", "small-deviation", "deviation-sectors")


def tables() -> None:
    """The tables of RESULTS.md and the figures."""
    found = results(PIECES, "ring")
    text = []
    if "turn" in found:
        m = found["turn"]["measured"]
        tracking = m["tracking_microseconds_per_turn"]
        rows = [
            [
                row["map"],
                row["label"],
                number(row["one_turn"]),
                number(row["after_turns"]),
                str(row["lost"]),
                number(row.get("defect")),
                number(row.get("fit_seconds")),
                number(row.get("microseconds_per_turn")),
                number(tracking / row["microseconds_per_turn"])
                if "microseconds_per_turn" in row
                else "–",
            ]
            for row in m["rows"]
        ]
        heads = (
            "`err.mat`, one turn",
            "largest",
            "one turn ÷ spread",
            f"after {m['turns']} turns",
            "lost",
            "defect",
            "fit, all in, CPU s",
            "CPU µs a turn",
            "times faster than tracking",
        )
        text.append(markdown(heads, rows))
    if "deviation" in found:
        parts = [found[name]["measured"] for name in OF_DELTA if name in found]
        rows = [
            [
                f"{1e3 * row['amplitude']:g} mm",
                str(row.get("pieces", 1)),
                f"{m['num_pairs']:,}",
                row["label"],
                f"{row['terms']:,}",
                number(row["one_turn"]),
                number(row["one_turn_median"]),
                number(row["after_turns"]),
                str(row["lost"]),
                number(row["defect"]),
                number(row["fit_seconds"]),
                number(row["microseconds_per_turn"]),
            ]
            for m in parts
            for row in m["rows"]
        ]
        heads = (
            "`err.mat`, δ in ±1 %, within",
            "pieces",
            "pairs",
            "largest",
            "terms",
            "one turn ÷ spread",
            "median",
            f"after {parts[0]['turns']} turns",
            "lost",
            "defect",
            "fit, all in, CPU s",
            "CPU µs a turn",
        )
        text.append(markdown(heads, rows))
    heads, rows = ("what", "measured", "asked"), []
    if "tunes" in found:
        difference = found["tunes"]["measured"]["largest_difference"]
        told = ", ".join(f"{name} {number(value)}" for name, value in difference.items())
        rows.append(["tunes of 18 orbits up to 1.8 mm, largest difference", told, "1e-6"])
    if "deviation" in found:
        told = ", ".join(
            f"{m['rows'][0].get('pieces', 1)} generated {number(m['largest_tune_difference'])}"
            for name in ("deviation", "deviation-sectors")
            if name in found
            for m in [found[name]["measured"]]
        )
        rows.append(["tunes against δ in ±1 %, largest difference", told, "1e-6"])
    if "frequencies" in found:
        m = found["frequencies"]["measured"]
        rows.append(
            [
                f"frequency map of `hmba.mat`, {m['side']}² orbits of {2 * m['turns']:,} passages "
                f"({m['label']}, one turn {number(m['one_turn'])}): median difference of log₁₀ of "
                f"the "
                "tunes' change",
                f"{number(m['median_difference'])} ({m['kept_by_one_only']} orbits "
                "lost by one of the two only)",
                "–",
            ]
        )
    if "long" in found:
        m = found["long"]["measured"]
        rows.append(
            [
                f"{m['particles']} particles, {m['turns']:,} turns: drift exponent of the mean "
                f"action",
                f"{number(m['drift_exponent'])} (change {number(m['change_at_the_end'])} of "
                f"itself; "
                f"{m['status'][0]} stayed in the domain; {number(m['seconds'])} s)",
                "0.6",
            ]
        )
    if "aperture" in found:
        m = found["aperture"]["measured"]
        rows.append(
            [
                f"dynamic aperture of `hmba.mat`, {m['turns']:,} passages, nine rays: largest "
                "difference",
                f"{100 * m['largest_difference']:.1f} % ({number(m['seconds'])} s; tracking "
                f"{number(m['tracking_seconds'])} s)",
                "5 %",
            ]
        )
    if rows:
        text.append(markdown(heads, rows))
    if text:
        between_markers(TABLES, "ring", "\n\n".join([*text, provenance(found)]))
    if {"tunes", "aperture"} <= set(found):
        tunes_and_aperture(found["tunes"]["measured"], found["aperture"]["measured"])
    if {"deviation", "frequencies"} <= set(found):
        maps_of_frequencies(
            found["deviation"]["measured"], found["frequencies"]["measured"], REGION
        )


if __name__ == "__main__":
    main(__doc__ or "", PIECES, "ring", tables, None, ("aperture",))
