"""The first run: three areas as processes, the same with lost messages, and the strategies side by side.

python examples/first_run.py
"""

import consensus_dsse as dsse


def main() -> None:
    result = dsse.run("ieee33")
    print(result)
    print(f"{result.verdict.gap_vm_pu:.1e} p.u. from the centralised estimate, files in {result.folder}")

    lossy = dsse.load_scenario("ieee33", changes={"faults.loss": 0.3})
    result = dsse.simulate(lossy, plots=False)
    print(f"with {result.verdict.lost} of {result.verdict.messages} messages lost: {result.verdict.gap_vm_pu:.1e} p.u.")

    table = dsse.compare(lossy)
    for strategy, gap, messages in zip(table.strategy, table.gap_vm_pu, table.messages, strict=True):
        print(f"{strategy:16}  {gap:.1e} p.u.  {messages} messages")


if __name__ == "__main__":  # `run` starts processes
    main()
