"""The bank: 400 concealed cases on which two versions of the diagnosis are compared, case by case.

All are burnt: their answers have been looked at before, so that nothing may be reported on them as unseen. Seeds lie
between 3000 and 4729; the 120 of the replay's suite `cases` are among them. Kinds are those of the seeds, two effects,
effects outside the catalogue and faults more often than in a draw; within a kind the rigs of the first attempts are
spread evenly, and laws and forms as they come. `bank.jsonl` has the tags of each case that has been drawn.

    python -m problems.bank                         cases by kind, rig, law and fault
    python -m problems.bank --draw --workers 2      draw the cases and write their tags; what is there stays
    python -m problems.replay bank --record         answer every case, and keep the answers
    python -m problems.replay bank                  compare with the answers kept
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from .concealed_case import case
from .concealed_rigs_more import RIGS

FILE = Path(__file__).with_name("bank.jsonl")
FIRST, LAST = 3000, 4729
SEED_LISTS = {
    "one": """
3003 3011 3022 3037 3090 3099 3107 3110 3125 3142 3160 3165 3167 3169 3175 3179 3182 3196 3199 3203 3208 3212 3214
3216 3224 3228 3240 3257 3277 3285 3295 3298 3326 3368 3372 3398 3402 3403 3405 3410 3411 3420 3423 3431 3475 3492
3504 3513 3519 3521 3535 3536 3574 3592 3608 3612 3642 3655 3669 3673 3685 3704 3705 3719 3720 3721 3724 3732 3743
3752 3767 3772 3815 3820 3837 3839 3842 3845 3848 3861 3864 3873 3897 3900 3914 3943 3953 3960 3963 3964 3998 4004
4005 4009 4024 4037 4044 4046 4048 4057 4071 4094 4095 4100 4114 4139 4149 4164 4168 4174 4179 4192 4194 4202 4212
4232 4245 4247 4268 4275 4280 4285 4309 4330 4331 4333 4334 4336 4341 4342 4344 4347 4351 4352 4353 4355 4356 4358
4359 4360 4361 4362 4366 4369 4372 4374 4375 4378 4380 4385 4386 4392 4395 4400 4401 4402 4403 4405 4406 4409 4412
4420 4421 4423 4426 4429 4431 4443 4448 4449 4450 4451 4455 4469 4471 4472 4478 4480 4481 4482 4488 4490 4497 4500
4509 4511 4519 4532 4539 4579 4595 4603 4616 4643 4644 4651 4655 4659 4684 4724
    """,
    "two": """
3019 3039 3061 3076 3126 3157 3217 3271 3281 3288 3291 3293 3299 3322 3338 3355 3386 3401 3428 3436 3481 3501 3523
3529 3547 3577 3583 3600 3628 3663 3681 3716 3726 3729 3737 3780 3807 3890 3891 3910 3913 3961 4033 4157 4200 4226
4227 4241 4252 4257 4267 4305 4316 4335 4345 4357 4363 4364 4371 4373 4411 4416 4417 4433 4437 4438 4441 4442 4445
4466 4513 4538 4585 4589 4599 4646 4688 4710 4713 4720
    """,
    "none": """
3074 3088 3117 3119 3201 3231 3265 3500 3698 3794 3830 3884 3946 3956 3971 3977 4178 4229 4278 4339 4350 4354 4383
4415 4418 4419 4440 4456 4464 4468 4504 4523 4568 4572 4575 4666
    """,
    "outside": """
3093 3108 3186 3233 3318 3444 3510 3558 3579 3657 3689 3763 3776 3898 4013 4030 4041 4080 4081 4110 4129 4136 4289
4332 4337 4349 4377 4381 4384 4390 4396 4408 4436 4444 4459 4484 4485 4487 4515 4554 4558 4576
    """,
    "fault": """
3025 3054 3189 3408 3439 3452 3463 3542 3554 3567 3573 3624 3647 3851 3932 4038 4111 4137 4165 4176 4184 4215 4321
4338 4340 4343 4346 4376 4387 4388 4462 4474 4483 4491 4501 4524 4527 4562 4571 4604 4645 4680
    """,
}
KINDS = {kind: tuple(int(seed) for seed in text.split()) for kind, text in SEED_LISTS.items()}
SEEDS = tuple(sorted(seed for seeds in KINDS.values() for seed in seeds))


def row(seed: int) -> dict[str, Any]:
    """Name, truth and tags of one case."""
    drawn = case(seed)
    truth = [[t["port"], t["law"]] for t in drawn.truth]
    return {"seed": seed, "name": drawn.name, "truth": truth, "tags": sorted(drawn.tags)}


def rows() -> dict[int, dict[str, Any]]:
    """Rows of the cases drawn so far."""
    lines = FILE.read_text(encoding="utf-8").splitlines() if FILE.exists() else []
    return {found["seed"]: found for found in map(json.loads, lines)}


def draw(workers: int) -> None:
    """Draw the cases that have no row yet."""
    done = rows()
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        for task in as_completed([pool.submit(row, seed) for seed in SEEDS if seed not in done]):
            done[task.result()["seed"]] = task.result()
            FILE.write_text("".join(json.dumps(done[s]) + "\n" for s in SEEDS if s in done), encoding="utf-8")
            print(f"[{len(done):3d}/{len(SEEDS)}] {task.result()['name']}", flush=True)


def balance() -> str:
    """Numbers of cases by kind, and of those drawn by rig, law, form, fault and noise."""
    found = rows()
    out = [f"{len(SEEDS)} cases, {len(found)} of them drawn", ""]
    out += [f"{kind:28}{len(seeds):5d}" for kind, seeds in KINDS.items()]
    tags = Counter(tag for r in found.values() for tag in r["tags"])
    laws = {law for r in found.values() for _, law in r["truth"]}
    groups = [
        ("rig", [t for t in tags if t in RIGS]),
        ("law", [t for t in tags if t in laws]),
        ("form", [t for t in tags if t.split(":")[0] in {*laws, "outside"} and ":" in t]),
        ("fault", [t for t in tags if t.startswith("fault:")]),
        ("noise", [t for t in tags if t in ("white", "coloured", "quantised")]),
    ]
    for name, of in groups:
        out += ["", name, *(f"    {tag:24}{tags[tag]:5d}" for tag in sorted(of))]
    return "\n".join(out)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the balance, or draw."""
    parser = argparse.ArgumentParser(prog="python -m problems.bank", description="The bank of concealed cases.")
    parser.add_argument("--draw", action="store_true", help="draw the cases that have no tags yet")
    parser.add_argument("--workers", type=int, default=1)
    a = parser.parse_args(arguments)
    if a.draw:
        draw(a.workers)
    print(balance())


if __name__ == "__main__":
    main()
