// The video of an entry's card, shown beside its name in a table while that is pointed at.
const peek = document.createElement("div");
peek.className = "peek";
peek.hidden = true;
peek.setAttribute("aria-hidden", "true");
document.body.append(peek);
const hide = () => { peek.hidden = true; peek.replaceChildren(); };
for (const link of document.querySelectorAll("tbody th a[href^='#entry-']")) {
  const video = document.querySelector(`${link.getAttribute("href")} video`);
  if (!video) continue;
  const show = () => {
    const copy = video.cloneNode();
    copy.removeAttribute("controls");
    peek.replaceChildren(copy);
    peek.hidden = false;
    const box = link.getBoundingClientRect();
    peek.style.left = `${Math.min(box.right + 16, innerWidth - peek.offsetWidth - 16)}px`;
    peek.style.top = `${Math.max(8, Math.min(box.top - 20, innerHeight - peek.offsetHeight - 16))}px`;
    copy.play().catch(() => {});
  };
  link.addEventListener("mouseenter", show);
  link.addEventListener("focus", show);
  link.addEventListener("mouseleave", hide);
  link.addEventListener("blur", hide);
}
addEventListener("scroll", hide, { passive: true });
