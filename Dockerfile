# Two images. `light` loads and scores buffers; `full` also simulates (software Vulkan), builds,
# trains and runs the tests:
#
#     docker build --target light --tag interference .
#     docker run --rm --volume "$PWD:/data" interference list namespace/name
#     docker build --target full --tag interference-full .
#     docker run --rm interference-full make test
#
# Every step is a script of this repository, which tests run without Docker.

FROM python:3.12-slim-bookworm AS light-install
WORKDIR /opt/robomme-interference
COPY . .
RUN scripts/install_light.sh build/light

FROM python:3.12-slim-bookworm AS light
COPY --from=light-install /opt/robomme-interference/build/light /opt/robomme-interference/build/light
ENV PATH=/opt/robomme-interference/build/light/bin:$PATH
WORKDIR /data
ENTRYPOINT ["robomme-interference"]
CMD ["doctor"]

FROM python:3.12-bookworm AS full
WORKDIR /opt/robomme-interference
COPY . .
RUN scripts/system_packages.sh vulkan chromium
RUN scripts/setup.sh
ENV PATH=/opt/robomme-interference/.venv/bin:$PATH
CMD ["robomme-interference", "doctor"]
