// Offers the other versions of these pages where a site has several: versions.json lies beside their folders.
// Without a network, or where there is no such file, nothing appears.
document.addEventListener("DOMContentLoaded", async () => {
  const select = document.getElementById("version");
  if (!select || !location.protocol.startsWith("http")) return;
  const site = new URL(`${document.documentElement.dataset.content_root}../`, location.href);
  const answer = await fetch(new URL("versions.json", site)).catch(() => null);
  if (!answer || !answer.ok) return;
  for (const version of await answer.json()) {
    select.add(new Option(version, version, false, version === select.dataset.version));
  }
  select.addEventListener("change", async () => {
    const home = new URL(`${encodeURIComponent(select.value)}/`, site);
    const same = new URL(select.dataset.page, home);
    const found = await fetch(same, { method: "HEAD" }).catch(() => null);
    location.href = found && found.ok ? same.href : home.href;
  });
  document.getElementById("versions").hidden = false;
});
