# Two images of one file. `services` is what a robot runs: router, hal, model, recorder. `workshop` is the same with what
# pretends to be a robot and what trains (pybullet, torch, matplotlib), which are twice as large as all the rest.
ARG PYTHON=python:3.11-slim-bookworm

FROM ${PYTHON} AS packages
ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
ENV PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_CACHE_DIR=1 PIP_ROOT_USER_ACTION=ignore
WORKDIR /build
RUN python -m venv --without-pip /opt/gemuco
COPY wheels/ wheels/
COPY deploy/install.sh deploy/requirements.py deploy/
COPY pyproject.toml constraints.txt ./
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

FROM ${PYTHON} AS services
# Numbers, so that a host without these names can give them its volumes and devices.
RUN groupadd --gid 10001 gemuco && useradd --uid 10001 --gid 10001 --no-create-home --home-dir /gemuco gemuco \
    && mkdir -p /gemuco/runs /run/gemuco && chown 10001:10001 /gemuco/runs /run/gemuco && chmod 700 /run/gemuco
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
RUN deploy/install.sh --target /opt/workshop =torch =matplotlib =pybullet =joblib +train +sim +studies

FROM services AS workshop
COPY --from=heavy /opt/workshop /opt/workshop
ENV PYTHONPATH=/opt/workshop MPLCONFIGDIR=/tmp/matplotlib
USER 10001:10001
