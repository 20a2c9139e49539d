FROM python:3.11-slim-bookworm
WORKDIR /app
COPY requirements/runtime.lock requirements/
RUN python -m pip install --no-cache-dir --require-hashes --only-binary :all: -r requirements/runtime.lock
COPY pyproject.toml README.md LICENSE ./
COPY trilat_net trilat_net
COPY sites sites
COPY recorder recorder
RUN python -m pip install --no-cache-dir --no-deps --no-build-isolation .
ENTRYPOINT ["trilat"]
