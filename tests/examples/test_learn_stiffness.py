"""The example that learns a stiffness finds what is stiff on pairs that it never saw, and how it moved."""

import re
import subprocess
import sys


def test_it_tells_stiff_from_soft_after_a_few_steps(root):
    script = [sys.executable, str(root / "examples" / "learn_stiffness.py")]
    few = ["--steps", "20", "--batch", "6", "--held-back", "16", "--seed", "0"]
    done = subprocess.run([*script, *few], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    ratio, auc = map(float, re.findall(r"inside / outside: (\S+), AUC (\S+)", done.stdout)[0])
    assert ratio > 5
    assert auc > 0.9
    (_, constant), (_, learned) = re.findall(r"\| (\d\.\d+) \| (\d\.\d+) \|", done.stdout)
    assert float(learned) < 0.9 * float(constant)
