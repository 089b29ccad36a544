#!/bin/sh
# Installs this folder for the services of host $host. The software itself is in $program (docs/deploy.md).
set -eu
cd "$$(dirname "$$0")"
[ "$$(id -u)" = 0 ] || { echo "install.sh: expected root, got $$(id -un): sudo ./install.sh" >&2; exit 1; }
[ -x $program ] || { echo "install.sh: expected $program, got nothing there: see docs/deploy.md" >&2; exit 1; }
id transport >/dev/null 2>&1 || useradd --system --no-create-home --shell /usr/sbin/nologin transport
mkdir -p $etc
for file in *; do
    case "$$file" in systemd | install.sh) ;; *) rm -rf "$etc/$$file"; cp -r "$$file" $etc/ ;; esac
done
chown -R root:transport $etc
chmod -R u=rwX,g=rX,o= $etc
cp systemd/*.service /etc/systemd/system/
systemctl daemon-reload
echo "installed; start with: systemctl start $services"
