"""Compare the strategy of this folder with the shipped ones; install it first: pip install examples/own_strategy

python examples/own_strategy/compare.py
"""

import consensus_dsse as dsse


def main() -> None:
    for loss in (0.0, 0.3):
        table = dsse.compare("ieee33", changes={"faults.loss": loss})
        print(f"{loss:.0%} of all messages lost")
        for strategy, gap, messages in zip(table.strategy, table.gap_vm_pu, table.messages, strict=True):
            print(f"  {strategy:16}  {gap:.1e} p.u. from the centralised estimate, {messages} messages")


if __name__ == "__main__":
    main()
