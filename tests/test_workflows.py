"""The recipes of wheels stand in the form that hosting sites run, and name existing things."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
WORKFLOW = ROOT / ".github" / "workflows" / "wheels.yml"


def checked(path, schema="workflows"):
    """The result of check-jsonschema for a file; the schemas come with the package."""
    program = Path(sys.executable).with_name("check-jsonschema")
    command = [str(program), "--builtin-schema", f"vendor.github-{schema}", str(path)]
    return subprocess.run(command, capture_output=True, text=True, timeout=60)


@pytest.mark.parametrize(
    ("folder", "schema"), [("workflows", "workflows"), ("ISSUE_TEMPLATE", "issue-forms")]
)
def test_files_for_the_forge_keep_to_their_schemas(folder, schema):
    files = sorted((ROOT / ".github" / folder).glob("*.yml"))
    assert len(files) == 2
    for path in files:
        result = checked(path, schema)
        assert result.returncode == 0, result.stdout


def test_the_workflow_of_tests_has_the_compiler_that_the_workspace_needs():
    rust = re.search(r'rust-version = "(\S+)"', (ROOT / "Cargo.toml").read_text())[1]
    assert f"image: rust:{rust}-" in WORKFLOW.with_name("tests.yml").read_text()


def test_the_workflow_keeps_to_the_schema_of_workflows(tmp_path):
    result = checked(WORKFLOW)
    assert result.returncode == 0, result.stdout
    # The program finds slips.
    text = WORKFLOW.read_text()
    slips = {"runs-on:": "runs:", "    steps:": "    stages:", "fail-fast: false": "fail-fast: 3"}
    for good, bad in slips.items():
        assert good in text
        (tmp_path / "wheels.yml").write_text(text.replace(good, bad))
        assert checked(tmp_path / "wheels.yml").returncode == 1


def test_it_builds_for_every_platform_with_the_compiler_that_the_workspace_needs():
    text = WORKFLOW.read_text()
    targets = re.findall(r"target: (\S+-\S+)", text)
    assert targets == [
        "x86_64-unknown-linux-gnu",
        "aarch64-unknown-linux-gnu",
        "aarch64-apple-darwin",
        "x86_64-apple-darwin",
        "x86_64-pc-windows-msvc",
    ]
    rust = re.search(r'rust-version = "(\S+)"', (ROOT / "Cargo.toml").read_text())[1]
    assert f"rustup toolchain install {rust} " in text
    pinned = re.findall(r"^(maturin|ziglang)==", (ROOT / "requirements-dev.txt").read_text(), re.M)
    assert sorted(pinned) == ["maturin", "ziglang"]


@pytest.mark.skipif(shutil.which("bash") is None, reason="the steps are for bash")
def test_its_scripts_are_read_by_the_shell_without_complaint():
    text = WORKFLOW.read_text()
    scripts = re.findall(r"        run: \|\n((?:          .*\n)+)", text)
    assert len(scripts) == 2
    for script in scripts:
        plain = re.sub(r"\$\{\{.*?\}\}", "x", script)
        result = subprocess.run(["bash", "-n"], input=plain, capture_output=True, text=True)
        assert result.returncode == 0, result.stderr
