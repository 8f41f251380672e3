set -o pipefail
python3 -m pip install -q --no-index --no-deps --no-compile --no-cache-dir --upgrade --target /tmp/site .whl/*.whl && export PYTHONPATH=/tmp/site:$PWD || exit 1
nvidia-smi -L; python3 -V
timeout 150 python3 .carry/bench.py 2>&1 | tee $OUT/bench.log
timeout 330 python3 -m pytest -q -x --maxfail=40 -n 12 -k "cuda or gpu" -p no:cacheprovider tests/core tests/solvers tests/fem tests/metrics tests/deformation tests/registration tests/nn tests/project/test_nn_pipelines.py 2>&1 | tail -60 | tee $OUT/tests.log
