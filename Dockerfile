# Runs both commands of README.md:
#   docker build -t ventosa .
#   docker run --rm -v "$PWD/results:/ventosa/results" ventosa    the main job
#   docker run --rm ventosa bash .ci/run                          linter, type checker and tests
FROM python:3.11-slim
# A compiler, where PyBullet has no wheel; git, for the tests.
RUN apt-get update \
    && apt-get install --yes --no-install-recommends g++ git \
    && rm -rf /var/lib/apt/lists/*
WORKDIR /ventosa
COPY . .
RUN python3.11 -m venv .venv && .venv/bin/pip install --no-cache-dir -c constraints.txt -e .
CMD [".venv/bin/python", "-m", "trainers.learn", "config/run.yaml"]
