"""What operators get: the compose file as Compose reads it, manifests as Kubernetes does, a dashboard of figures there
are."""

from __future__ import annotations

import json
import re

import pytest
import yaml

from services.settings import settings_from
from tests.services.service_process import ROOT

TEXT = (ROOT / "docker-compose.yml").read_text()
_VARIABLE = re.compile(r"\$(?:\$|\{(\w+)(?::?([-?])([^}]*))?\}|(\w+))")


def resolved(text: str, environment: dict[str, str]) -> str:
    """With variables put in as Compose does (compose-spec, 12-interpolation). Raises KeyError for one that must be
    set."""

    def value(match: re.Match) -> str:
        name, how, otherwise = match[1] or match[4], match[2], match[3]
        if match[0] == "$$":
            return "$"
        if how == "?" and not environment.get(name):
            raise KeyError(otherwise)
        return environment.get(name) or (otherwise if how == "-" else "")

    return _VARIABLE.sub(value, text)


def merged(text: str) -> str:
    """With YAML's anchors and merges done."""
    return yaml.safe_dump(yaml.safe_load(text))


@pytest.mark.parametrize(
    "environment",
    [{}, {"SPLATPRESS_PUBLISH": "0.0.0.0:80", "SPLATPRESS_DOMAIN": "a.example", "POSTGRES_PASSWORD_FILE": "/run/p"}],
)
def test_compose__is_valid_by_the_schema_with_and_without_its_variables(environment):
    compose_spec = pytest.importorskip("compose_spec", reason="compose-spec is not installed")
    text = resolved(TEXT, environment)
    assert "$" not in text
    found = compose_spec.PyCompose.from_yaml(merged(text))
    found.validate()
    spec = found.to_spec()
    known = yaml.safe_load(text)["services"]
    assert set(spec.services) == set(known)
    assert known["api"]["ports"] == [environment.get("SPLATPRESS_PUBLISH", "127.0.0.1:8000") + ":8000"]


def test_compose__an_unknown_word_is_no_compose_file():
    compose_spec = pytest.importorskip("compose_spec", reason="compose-spec is not installed")
    with pytest.raises(Exception, match="mem_limits"):
        compose_spec.PyCompose.from_yaml(
            merged(resolved(TEXT, {})).replace(" mem_limit: 6g", " mem_limits: 6g")
        ).to_spec()


def test_compose__no_secret_is_a_variable_of_a_process():
    compose = yaml.safe_load(TEXT)
    for name, service in compose["services"].items():
        told = service.get("environment") or {}
        secret = {key for key in told if re.search("PASSWORD|SECRET|TOKEN", key)}
        assert all(key.endswith("_FILE") and told[key].startswith("/run/secrets/") for key in secret), name
        assert bool(secret) == (service.get("secrets") == ["postgres_password"]), name
    assert set(compose["secrets"]) == {"postgres_password"}


def test_settings__a_value_may_stand_in_a_file(tmp_path):
    (tmp_path / "word").write_text("p@ss/word\n")
    found = settings_from(
        {
            "SPLATPRESS_DATABASE": "postgresql://splatpress@postgres:5432/splatpress",
            "SPLATPRESS_DATABASE_PASSWORD_FILE": str(tmp_path / "word"),
        }
    )
    assert found.database_url == "postgresql://splatpress:p%40ss%2Fword@postgres:5432/splatpress"
    with pytest.raises(OSError, match="none"):
        settings_from({"SPLATPRESS_PORT_FILE": str(tmp_path / "none")})


def test_compose__a_card_draws_where_there_is_one():
    services = yaml.safe_load(TEXT)["services"]
    gpu = services["render-worker-gpu"]
    assert gpu["command"] == services["render-worker"]["command"] and gpu["profiles"] == ["gpu"]
    (device,) = gpu["deploy"]["resources"]["reservations"]["devices"]
    assert device["driver"] == "nvidia" and "graphics" in device["capabilities"]
    assert "graphics" in gpu["environment"]["NVIDIA_DRIVER_CAPABILITIES"]  # else the driver's EGL stays outside


def figures() -> set[str]:
    """The names in `/metrics`."""
    from fastapi.testclient import TestClient

    from services.api.app import create_app

    with TestClient(create_app(settings_from({}, data=FIGURES)), base_url="http://127.0.0.1") as api:
        return set(re.findall(r"^# TYPE (\S+)", api.get("/metrics").text, re.M))


@pytest.fixture(autouse=True)
def _folder(tmp_path):
    global FIGURES
    FIGURES = tmp_path / "figures"
    FIGURES.mkdir()


def test_grafana__every_panel_asks_for_figures_that_there_are():
    board = json.loads((ROOT / "deploy" / "grafana" / "splatpress.json").read_text())
    known = figures()
    asked = [target["expr"] for panel in board["panels"] for target in panel.get("targets", [])]
    names = [set(re.findall(r"\bsplatpress_\w+", expression)) for expression in asked]
    assert len(asked) >= 8 and all(names) and set().union(*names) == known - {"splatpress_time_seconds"}
    assert all(panel["title"] and panel["datasource"]["uid"] == "${datasource}" for panel in board["panels"])
    for a in board["panels"]:
        for b in board["panels"]:
            (x, y, w, h), (u, v, m, n) = (tuple(p["gridPos"][k] for k in "xywh") for p in (a, b))
            assert a is b or x + w <= u or u + m <= x or y + h <= v or v + n <= y, (a["title"], b["title"])


def manifests() -> list[dict]:
    folder = ROOT / "deploy" / "kubernetes"
    listed = yaml.safe_load((folder / "kustomization.yaml").read_text())["resources"]
    assert sorted(listed) == sorted(p.name for p in folder.glob("*.yaml") if p.name != "kustomization.yaml")
    return [found for name in listed for found in yaml.safe_load_all((folder / name).read_text())]


def test_kubernetes__manifests_are_valid_by_the_schemas_of_kubernetes():
    validate = pytest.importorskip("kubernetes_validate", reason="kubernetes-validate is not installed").validate
    plain = [m for m in manifests() if not m["apiVersion"].startswith("kubernetes.dask.org/")]
    assert {m["kind"] for m in plain} >= {"Deployment", "StatefulSet", "Service", "NetworkPolicy", "Secret"}
    for manifest in plain:
        validate(manifest, "1.31", strict=True)


def pods() -> dict[str, dict]:
    """The pods that our image runs in, by name."""
    found = {}
    for m in manifests():
        spec = m.get("spec", {})
        if m["kind"] == "Deployment":
            found[m["metadata"]["name"]] = spec["template"]["spec"]
        elif m["kind"] == "DaskCluster":
            found |= {"scheduler": spec["scheduler"]["spec"], "worker": spec["worker"]["spec"]}
        elif m["kind"] == "DaskWorkerGroup":
            found[m["metadata"]["name"]] = spec["worker"]["spec"]
    return found


def test_kubernetes__pods_are_as_shut_in_as_containers_of_compose_and_run_the_same_commands():
    compose, found = yaml.safe_load(TEXT)["services"], pods()
    assert set(found) == {"api", "runner", "scheduler", "worker", "render-worker"}
    for name, pod in found.items():
        assert pod["securityContext"]["runAsUser"] == 10001 and pod["securityContext"]["runAsNonRoot"], name
        (container,) = pod["containers"]
        kept = container["securityContext"]
        assert kept["readOnlyRootFilesystem"] and kept["capabilities"]["drop"] == ["ALL"], name
        assert (
            kept["allowPrivilegeEscalation"] is False and {"memory", "cpu"} <= container["resources"]["limits"].keys()
        )
        assert re.search(r":\d+\.\d+", container["image"]), name
        told = {e["name"]: e.get("value") for e in container.get("env", [])}
        assert not [key for key in told if re.search("PASSWORD|SECRET", key) and not key.endswith("_FILE")], name
        if name in ("worker", "render-worker"):
            for key, value in compose[name]["environment"].items():
                assert told[key] == str(value), (name, key)
            resource = compose[name]["command"][compose[name]["command"].index("--resources") + 1]
            assert resource in container["args"], name
    dask = {m["kind"]: m for m in manifests() if m["apiVersion"].startswith("kubernetes.dask.org/")}
    assert {"DaskCluster", "DaskWorkerGroup", "DaskAutoscaler"} <= dask.keys()
    autoscaler = dask["DaskAutoscaler"]["spec"]
    assert (
        autoscaler["cluster"] == dask["DaskCluster"]["metadata"]["name"] == dask["DaskWorkerGroup"]["spec"]["cluster"]
    )


def test_kubernetes__the_scheduler_is_reached_by_our_pods_alone():
    policies = {m["metadata"]["name"]: m["spec"] for m in manifests() if m["kind"] == "NetworkPolicy"}
    for name in ("scheduler", "postgres", "workers"):
        for rule in policies[name]["ingress"]:
            assert all("podSelector" in peer and set(peer) == {"podSelector"} for peer in rule["from"]), name
