# Two images of one file. `services` is what a robot runs: router, hal, model, recorder. `workshop` is the same with what
# pretends to be a robot and what trains (pybullet, matplotlib), which is larger than all the rest.
# A tag may change: `docker buildx imagetools inspect` prints its digest, which GEMUCO_PYTHON in .env fixes (docs/deploy.md).
ARG PYTHON=python:3.11-slim-bookworm

FROM ${PYTHON} AS packages
ENV PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_CACHE_DIR=1 PIP_ROOT_USER_ACTION=ignore
WORKDIR /build
RUN python -m venv --without-pip /opt/gemuco
COPY wheels/ wheels/
COPY deploy/install.sh deploy/requirements.py deploy/sbom.py deploy/
COPY pyproject.toml constraints.txt requirements.lock ./
RUN deploy/install.sh
COPY README.md LICENSE ./
COPY gemuco/ gemuco/
COPY hal/ hal/
COPY simulators/ simulators/
COPY services/ services/
COPY studies/ studies/
# Layers keep whole seconds, and compiled code counts as old when the time of its source is another one. -P: what is
# installed is made ready, and not the sources that lie here.
RUN deploy/install.sh . && find /opt/gemuco -path '*/gemuco/compiled/*.py' -exec touch --date=@1000000000 {} + \
    && /opt/gemuco/bin/python -P -m gemuco.warm
RUN python deploy/sbom.py /opt/gemuco/sbom.json /opt/gemuco/lib/python3.*/site-packages

FROM ${PYTHON} AS services
# Numbers, so that a host without these names can give them its volumes and devices. docker-compose.yml gives each service
# a user of its own in this group, which shares what lies in runs/.
RUN groupadd --gid 10001 gemuco && number=10001 \
    && for name in router hal model recorder simulator train; do \
        useradd --uid $number --gid 10001 --no-create-home --home-dir /gemuco gemuco-$name && number=$((number + 1)); done \
    && mkdir -p /gemuco/runs /run/gemuco /run/buses && chown 10001:10001 /gemuco/runs /run/gemuco \
    && chmod 2775 /gemuco/runs && chmod 700 /run/gemuco
COPY --from=packages /opt/gemuco /opt/gemuco
COPY robots/ /gemuco/robots/
COPY LICENSE /gemuco/
ENV PATH=/opt/gemuco/bin:$PATH PYTHONUNBUFFERED=1 XDG_RUNTIME_DIR=/run/gemuco
WORKDIR /gemuco
USER 10001:10001
ENTRYPOINT ["gemuco"]
CMD ["--help"]

FROM packages AS heavy
# Only what the first image lacks, in a folder of its own: both images share all the layers below it.
RUN deploy/install.sh --target /opt/workshop =matplotlib =pybullet =joblib +train +sim +studies \
    && python deploy/sbom.py /opt/workshop/sbom.json /opt/gemuco/lib/python3.*/site-packages /opt/workshop

FROM services AS workshop
COPY --from=heavy /opt/workshop /opt/workshop
ENV PYTHONPATH=/opt/workshop MPLCONFIGDIR=/tmp/matplotlib
USER 10001:10001
