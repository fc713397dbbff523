"""The tables of the thesis beside ours: how far apart, and which of its numbers are misprints.

python examples/thesis.py
"""

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

    # The thesis's own mode moves truth and estimate together. On one true grid its method has this gap:
    compared = dsse.compare("ieee33", strategies=["angle-offset", "information"])
    for strategy, gap in zip(compared.strategy, compared.gap_vm_pu, strict=True):
        print(f"{strategy}: {gap:.1e} p.u. from the centralised estimate")


if __name__ == "__main__":
    main()
