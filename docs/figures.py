# SPDX-License-Identifier: Apache-2.0
"""Makes the pictures of the README, small PNGs in this folder, from the results of `make paper`.

python docs/figures.py out/paper
"""

import sys
from pathlib import Path

from PIL import Image

PICTURES = ("hysteresis", "feedforward", "step", "step_closed_loop", "frequency", "thermal")
WIDTH = 900  # pixels
COLOURS = 64


def main() -> int:
    results = Path(sys.argv[1] if len(sys.argv) > 1 else "out/paper")
    for name in PICTURES:
        picture = Image.open(results / f"{name}.png").convert("RGB")
        if picture.width > WIDTH:
            picture = picture.resize((WIDTH, round(picture.height * WIDTH / picture.width)))
        target = Path(__file__).parent / f"{name}.png"
        picture.quantize(COLOURS).save(target, optimize=True)
        print(f"{target}: {target.stat().st_size // 1024} KiB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
