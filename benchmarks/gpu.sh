#!/usr/bin/env bash
# What a GPU does: tests that need one, then the tables of docs/findings/performance.md, in about ten minutes.
#
#     benchmarks/gpu.sh [FOLDER]      results go to FOLDER (gpu-results)
#
# Give it a machine with a CUDA build of PyTorch and `pip install -e '.[dev,codecs]'`.
set -uo pipefail
cd "$(dirname "$0")/.."
folder=${1:-gpu-results}
python=${PYTHON:-$([ -x .venv/bin/python ] && echo .venv/bin/python || command -v python3)}
"$python" -c 'import sys, torch; sys.exit(not torch.cuda.is_available())' || {
  echo "PyTorch sees no GPU here: install its CUDA build, and check nvidia-smi" >&2
  exit 2
}
mkdir -p "$folder"
failed=0

# part NAME COMMAND…: shows what it prints, keeps it in NAME.txt, and goes on if it fails
part() {
  local name=$1
  shift
  echo "== $name: $*"
  if ! "$@" 2>&1 | tee "$folder/$name.txt"; then
    echo "$name failed, see $folder/$name.txt" >&2
    failed=1
  fi
}

{
  nvidia-smi --query-gpu=name,driver_version,memory.total --format=csv
  "$python" -c 'import torch; print("PyTorch", torch.__version__, "CUDA", torch.version.cuda)'
  git describe --always --dirty
} 2>&1 | tee "$folder/machine.txt"
part tests "$python" -m pytest -q -n 0 -m gpu tests/training
part memory "$python" benchmarks/memory.py --clips 1 --clips 4
part training "$python" benchmarks/training.py --size small --size dit_s
part large "$python" benchmarks/training.py --size dit_m --size dit_l --size dit_xl --precision bfloat16 --no-compile --repetitions 4
part loading "$python" benchmarks/loading.py --size 64 --seconds 5
part rollout "$python" benchmarks/rollout.py --device cuda --size 240 --steps 4,50 --model dit_xs --model dit_s
part serve "$python" benchmarks/serve.py push_cube --clients 64 --minutes 1
echo "results are in $folder"
exit $failed
