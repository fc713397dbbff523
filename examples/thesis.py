"""The tables of the thesis beside ours: how far apart, and which of its numbers are misprints.

python examples/thesis.py
"""

from statistics import median_low

import numpy as np

import consensus_dsse as dsse


def main() -> None:
    table = dsse.thesis()
    for number in dict.fromkeys(table.table):
        rows = [k for k in range(len(table)) if table.table[k] == number and not table.misprint[k]]
        vm, va = abs(table.difference_vm_pu[rows]).max(), abs(table.difference_va_deg[rows]).max()
        print(f"table {number:5}  {vm:.4f} p.u.  {va:.4f} degrees  {table.ours[rows[0]]}")
    for k, text in enumerate(table.misprint):
        if text:
            print(f"table {table.table[k]}, bus {table.printed_bus[k]}: {text}")

    # How large is the effect that a table shows beside its difference to ours?
    for number in dict.fromkeys(name for name, base in zip(table.table, table.against, strict=True) if base):
        rows = [k for k in range(len(table)) if table.table[k] == number]
        printed, ours = (np.nanmax(abs(x[rows])) for x in (table.printed_effect_va_deg, table.effect_va_deg))
        print(f"table {number} against {table.against[rows[0]]}: {printed:.4f} degrees as printed, {ours:.4f} here")

    # Its question, on one true grid: what does an error of the load messages do to the states?
    both = "faults.load_error.all.p_mw,faults.load_error.all.q_mvar"
    strategies = ["angle-offset", "information"]
    runs = dsse.sweep("ieee33-load-error", {both: [0.0, 0.2, 0.4, 0.6]}, strategies=strategies, seeds=20)
    error_mw, strategy = runs["faults.load_error.all.p_mw"], np.array(runs.strategy)
    for name in strategies:
        errors = [runs.error_vm_pu[(strategy == name) & (error_mw == x)] for x in np.unique(error_mw)]
        print(f"{name}: error of magnitudes {', '.join(f'{median_low(x):.4f}' for x in errors)} p.u.")

    # The thesis's own mode moves truth and estimate together. On one true grid its method has this gap:
    compared = dsse.compare("ieee33", strategies=["angle-offset", "information"])
    for strategy, gap in zip(compared.strategy, compared.gap_vm_pu, strict=True):
        print(f"{strategy}: {gap:.1e} p.u. from the centralised estimate")


if __name__ == "__main__":
    main()
