# One image for every member of a session. What builds it stays behind in the first stage; the second one
# adds a virtual environment to Python and nothing else: no build tools, no pip, no tests.
# BASE=python@sha256:... builds on one image and no other. The tag stands here and no digest, because a digest that
# nobody renews keeps the holes of its day; pin the one of today, and renew it by the same two lines:
#   docker pull python:3.11-slim-bookworm
#   BASE=$(docker image inspect --format '{{index .RepoDigests 0}}' python:3.11-slim-bookworm) docker compose build
ARG BASE=python:3.11-slim-bookworm
FROM ${BASE} AS build
# An eighth of what is installed below is symbols for debuggers; `strip` takes them out.
RUN { apt-get -qq -o Acquire::Retries=0 -o Acquire::http::Timeout=10 update \
        && apt-get -qq install --no-install-recommends binutils >/dev/null 2>&1; } \
    || echo "Debian's mirror is out of reach, so there is no strip: the image will be 55 MB larger"
RUN python -m venv --without-pip /opt/trilat
WORKDIR /opt/trilat/lib/python3.11/site-packages
COPY requirements/runtime.lock /src/requirements/
RUN python -m pip --python /opt/trilat/bin/python install --quiet --no-cache-dir --disable-pip-version-check \
        --require-hashes --only-binary :all: -r /src/requirements/runtime.lock \
    && find . -depth -type d -name tests -exec rm -r {} + \
    && { ! command -v strip || find llvmlite zenoh zstandard kiwisolver fontTools -name '*.so' \
        -exec strip --strip-unneeded {} +; }
COPY pyproject.toml README.md LICENSE /src/
COPY trilat_net /src/trilat_net
COPY sites /src/sites
COPY recorder /src/recorder
COPY packages /src/packages
# Whole seconds, because an image keeps no others, and a cache of compiled code goes by the time of its source.
RUN python -m pip --python /opt/trilat/bin/python install --quiet --no-cache-dir --disable-pip-version-check \
        --no-deps --no-build-isolation --no-compile /src /src/packages/trilat-* \
    && python -m pip --python /opt/trilat/bin/python uninstall --quiet --yes setuptools \
    && find trilat_net sites recorder trilat_people trilat_ros2 trilat_studies -exec touch -d "@$(date +%s)" {} + \
    && /opt/trilat/bin/python -m compileall -q trilat_net sites recorder trilat_people trilat_ros2 trilat_studies
COPY containers/entry.py /opt/trilat/entry.py
# A run and its report show that the image works, and leave what they compiled.
ENV XDG_CACHE_HOME=/opt/trilat/cache
RUN /opt/trilat/bin/trilat sim paper --duration 0.1 -o /tmp/run.mcap \
    && /opt/trilat/bin/trilat report /tmp/run.mcap \
    && /opt/trilat/bin/python -c 'import recorder.record_process, sites.site_process, trilat_net as tn; from sites.site_parts import warm_up; warm_up(tn.load_scenario("paper"), "m1")' \
    && chmod -R a+rX /opt/trilat

FROM ${BASE}
COPY --from=build /opt/trilat /opt/trilat
# /tmp is the one place that a member writes to.
ENV PATH=/opt/trilat/bin:$PATH \
    PYTHONDONTWRITEBYTECODE=1 \
    PYTHONUNBUFFERED=1 \
    HOME=/tmp \
    XDG_CACHE_HOME=/tmp/cache \
    COLUMNS=120
# A new volume takes over the rights of its folder: whoever makes the keys may write there.
RUN install -d -m 1777 /keys/recorder /keys/operator /keys/m1 /keys/m2 /keys/s
USER 10001:10001
ENTRYPOINT ["python", "-I", "/opt/trilat/entry.py", "trilat"]
