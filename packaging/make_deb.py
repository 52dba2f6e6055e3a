"""Makes the Debian package: the daemon in an environment of its own under /opt/emb_daemon, its kernels compiled ahead.

    make deb                                  for this machine, in dist
    make deb DEB_MACHINE="x86_64 aarch64"     for several, compiling once

Needs dpkg-deb, a linker for the machine (`emb-daemon compile` says which), and the wheel in dist. The package runs with the
Python of the Debian release that it was made on: compiled wheels are for one version of it.
"""

import argparse
import shutil
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

from emb_daemon.ahead.library import read_manifest, source_digest
from emb_daemon.cli.main import main as emb_daemon

ROOT = Path(__file__).resolve().parent.parent
#: Architecture, and pip's names of the oldest libc that wheels are taken for: Debian 11 has 2.31.
MACHINES = {
    "x86_64": ("amd64", ("manylinux_2_28_x86_64", "manylinux2014_x86_64")),
    "aarch64": ("arm64", ("manylinux_2_28_aarch64", "manylinux2014_aarch64")),
}
_HOME = "opt/emb_daemon"
#: Files of the project, and the folders into which they are installed; those in /etc become conffiles, which an update keeps.
_FILES = {
    "config/emb.yaml": "etc/emb_daemon",
    "config/calibration.yaml": "etc/emb_daemon",
    "systemd/emb-daemon.service": "usr/lib/systemd/system",
    "systemd/emb-daemon.service.d/ahead.conf": "usr/lib/systemd/system/emb-daemon.service.d",
    "systemd/emb-daemon-uds.service": "usr/lib/systemd/system",
    "systemd/60-emb-daemon.conf": "usr/lib/sysctl.d",
    "systemd/80-can0.network": "usr/share/doc/emb-daemon/examples",
    "systemd/80-can0.link": "usr/share/doc/emb-daemon/examples",
}


def system_python() -> str:
    """Version of Debian's Python, like "3.11"."""
    code = "import sys; print('%d.%d' % sys.version_info[:2])"
    return subprocess.run(["/usr/bin/python3", "-c", code], capture_output=True, text=True, check=True).stdout.strip()


def fetch_packages(site: Path, machine: str, python: str) -> None:
    """Install the daemon's dependencies, checked against the hashes of the lock file, into ``site``."""
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--require-hashes",
               "--no-deps", "--no-compile", "--only-binary=:all:", "--implementation=cp", f"--python-version={python}",
               f"--abi=cp{python.replace('.', '')}", "--abi=abi3", "--abi=none", f"--target={site}",
               *(f"--platform={name}" for name in MACHINES[machine][1]), "-r", ROOT / "requirements-ahead.lock"]  # fmt: skip
    subprocess.run(command, check=True)
    # Scripts that nobody calls; they would start the Python that runs pip here.
    shutil.rmtree(site / "bin", ignore_errors=True)


def lay_out(root: Path, wheel: Path, kernels: Path, python: str) -> None:
    """Put everything but the dependencies below ``root``."""
    home, site = root / _HOME, site_of(root, python)
    site.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
    (home / "bin").mkdir()
    (home / "bin/python").symlink_to(f"/usr/bin/python{python}")
    (home / "pyvenv.cfg").write_text(f"home = /usr/bin\ninclude-system-site-packages = false\nversion = {python}\n")
    script = home / "bin/emb-daemon"
    script.write_text(f"#!/{_HOME}/bin/python -s\nimport sys\n\nfrom emb_daemon.cli.main import main\n\nsys.exit(main())\n")
    script.chmod(0o755)
    for name, folder in {**_FILES, kernels: f"{_HOME}/lib/emb_daemon", ROOT / "LICENSE": "usr/share/doc/emb-daemon"}.items():
        (root / folder).mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, root / folder)
    (root / "usr/share/doc/emb-daemon/LICENSE").rename(root / "usr/share/doc/emb-daemon/copyright")
    completion = root / "usr/share/bash-completion/completions/emb-daemon"
    completion.parent.mkdir(parents=True)
    shutil.copy(ROOT / "completion/emb-daemon.bash", completion)
    (root / "usr/bin").mkdir()
    (root / "usr/bin/emb-daemon").symlink_to(f"/{_HOME}/bin/emb-daemon")


def site_of(root: Path, python: str) -> Path:
    """The folder of Python packages below ``root``."""
    return root / _HOME / "lib" / f"python{python}" / "site-packages"


def compile_bytecode(root: Path) -> None:
    """Compile all modules, because the service cannot write bytecode; Python uses it without comparing times of files."""
    command = ["/usr/bin/python3", "-m", "compileall", "-q", "-s", root, "-p", "/", "--invalidation-mode", "unchecked-hash",
               root / _HOME / "lib"]  # fmt: skip
    subprocess.run(command, check=True)


def pack(root: Path, version: str, architecture: str, python: str, folder: Path) -> Path:
    """The package of all that is below ``root``; its path in ``folder``."""
    debian = root / "DEBIAN"
    debian.mkdir()
    major, minor = python.split(".")
    size = sum(path.lstat().st_size for path in root.rglob("*") if path.is_file() and not path.is_symlink()) // 1024
    values = {
        "version": version,
        "architecture": architecture,
        "size": size,
        "python": f"python{python}, python3 (>= {python}~), python3 (<< {major}.{int(minor) + 1}~)",
    }
    (debian / "control").write_text((ROOT / "packaging/debian/control").read_text().format(**values))
    (debian / "conffiles").write_text(
        "".join(f"/etc/emb_daemon/{path.name}\n" for path in sorted((root / "etc/emb_daemon").iterdir()))
    )
    for name in ("postinst", "prerm", "postrm"):
        shutil.copy(ROOT / "packaging/debian" / name, debian)
        (debian / name).chmod(0o755)
    # Only root can write files that the daemon executes, whatever the umask here.
    for path in root.rglob("*"):
        if not path.is_symlink():
            path.chmod(0o755 if path.is_dir() or path.stat().st_mode & 0o100 else 0o644)
    root.chmod(0o755)
    package = folder / f"emb-daemon_{version}_{architecture}.deb"
    # Level 3 takes half a minute instead of a minute at the best level, and makes the package a ninth larger.
    subprocess.run(
        ["dpkg-deb", "--root-owner-group", "-Zxz", "-z3", "--build", root, package], check=True, stdout=subprocess.DEVNULL
    )
    return package


def make(wheel: Path, machine: str, python: str) -> Path:
    """The package for a machine, beside the wheel."""
    with tempfile.TemporaryDirectory() as name:
        root, kernels = Path(name, "root"), Path(name, "kernels.so")
        # Called in this process: kernels compiled for one machine need only be emitted again for the next.
        if emb_daemon(["compile", "--target", machine, "--output", str(kernels)]):
            sys.exit(1)
        fetch_packages(site_of(root, python), machine, python)
        lay_out(root, wheel, kernels, python)
        if read_manifest(kernels).sources != source_digest(site_of(root, python) / "emb_daemon"):
            sys.exit(f"{wheel}: was built from other sources than {ROOT}; run make wheel")
        compile_bytecode(root)
        return pack(root, wheel.name.split("-")[1], MACHINES[machine][0], python, wheel.parent)


def main() -> None:
    parser = argparse.ArgumentParser(description="Debian packages, in the wheel's folder.")
    parser.add_argument("wheel", type=Path, help="the project's wheel")
    parser.add_argument("--machine", nargs="+", choices=MACHINES, default=["x86_64"])
    arguments = parser.parse_args()
    for machine in arguments.machine:
        print(make(arguments.wheel, machine, system_python()))


if __name__ == "__main__":
    main()
