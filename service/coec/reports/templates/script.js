"use strict";
for (const button of document.querySelectorAll("button[data-copy]")) {
  const said = button.closest(".copies").querySelector(".said");
  const tell = (text) => { said.textContent = ""; requestAnimationFrame(() => { said.textContent = text; }); };
  const select = () => {
    // The exact text, off the screen: what is shown has fewer digits.
    const area = document.createElement("textarea");
    area.value = button.dataset.copy;
    area.readOnly = true;
    area.className = "exact";
    area.setAttribute("aria-label", button.getAttribute("aria-label"));
    button.closest(".copy").append(area);
    area.select();
    return area;
  };
  button.addEventListener("click", async () => {
    try {
      await navigator.clipboard.writeText(button.dataset.copy);
      tell("Copied.");
    } catch {
      // No clipboard, or no permission: the older way, which needs none; and where that is refused, the text to take.
      button.closest(".copy").querySelector("textarea")?.remove();
      const area = select();
      if (document.execCommand("copy")) {
        area.remove();
        button.focus();
        tell("Copied.");
      } else {
        area.classList.add("seen");
        area.focus();
        area.select();
        tell("The text is selected: copy it with Ctrl+C.");
      }
    }
  });
}
for (const figure of document.querySelectorAll(".compare")) {
  const slider = figure.querySelector(".slider");
  const range = slider.querySelector("input");
  const show = () => figure.style.setProperty("--cut", range.value + "%");
  figure.classList.add("slid");
  slider.hidden = false;
  range.addEventListener("input", show);
  show();
}
// What does not scroll need not be reached by the keyboard.
const reach = () => {
  for (const region of document.querySelectorAll(".scroll")) {
    if (region.scrollWidth > region.clientWidth) region.tabIndex = 0;
    else region.removeAttribute("tabindex");
  }
};
addEventListener("resize", reach);
reach();
