"use strict";
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const all = (selector, root = document) => [...root.querySelectorAll(selector)];
  const stages = document.querySelector(".stages");
  const controls = document.querySelector(".controls");
  const source = (name, plane) =>
    document.querySelector(`img[data-name="${name}"][data-plane="${plane}"]`).src;

  // A picture that is shown twice is kept once.
  const fill = (image) => { image.src = source(image.dataset.copy, image.dataset.plane); };
  all("img[data-copy]").forEach(fill);

  const showSlice = (plane, k) => {
    document.body.style.setProperty(`--at-${plane}`, `${data[plane].positions[k]}%`);
    all(`output[data-plane="${plane}"]`).forEach((output) => { output.textContent = data[plane].labels[k]; });
    Object.entries(data[plane].lines).forEach(([id, paths]) =>
      document.getElementById(`${id}-${plane}`).setAttribute("d", paths[k]));
  };
  all(".slice-number").forEach((input) => {
    const show = () => {
      input.setAttribute("aria-valuetext", data[input.dataset.plane].labels[input.value]);
      showSlice(input.dataset.plane, Number(input.value));
    };
    input.addEventListener("input", show);
    show();
  });

  const sliders = all(".slice-number");
  const worst = document.getElementById("worst");
  if (worst) worst.addEventListener("click", () => sliders.forEach((input) => {
    input.value = data[input.dataset.plane].start;
    input.dispatchEvent(new Event("input"));
  }));

  // What is drawn over the images is shown or hidden by kind.
  all("input[name=shown]").forEach((input) => {
    const draw = () => document.body.classList.toggle(`no-${input.value}`, !input.checked);
    input.addEventListener("change", draw);
    draw();
  });

  // Flicker: by itself, unless the person wants less motion, or by hand.
  const auto = document.getElementById("auto");
  const swap = () => stages.classList.toggle("first");
  setInterval(() => { if (stages.dataset.mode === "flicker" && auto.checked) swap(); }, 600);
  if (matchMedia("(prefers-reduced-motion: reduce)").matches) auto.checked = false;
  document.getElementById("swap").addEventListener("click", () => { auto.checked = false; swap(); });

  controls.addEventListener("submit", (event) => event.preventDefault());
  all("input[name=mode]").forEach((input) => input.addEventListener("change", () => choose(input.value)));
  const choose = (mode) => { stages.dataset.mode = controls.dataset.shown = mode; };
  all("input[name=other]").forEach((input) => input.addEventListener("change", () => other(input)));
  const other = (input) => {
    all(".above img").forEach((image) => { image.dataset.copy = input.value; fill(image); });
    all(".other-title").forEach((title) => { title.textContent = input.dataset.title; });
    all(".stage use").forEach((use) => {
      use.toggleAttribute("hidden", !["fixed", input.value].includes(use.dataset.image));
    });
  };

  const swipe = document.getElementById("swipe");
  const tile = document.getElementById("tile");
  const line = () => all(".stage").forEach((stage) => stage.style.setProperty("--line", `${swipe.value}%`));
  const tiles = () => stages.style.setProperty("--tile", `${2 * tile.value}px`);
  swipe.addEventListener("input", line);
  tile.addEventListener("input", tiles);
  all(".stage").forEach((stage) => {
    const drag = (event) => {
      if (stages.dataset.mode !== "swipe" || (event.type === "pointermove" && !event.buttons)) return;
      const box = stage.getBoundingClientRect();
      swipe.value = 100 * (event.clientX - box.left) / box.width;
      line();
    };
    stage.addEventListener("pointerdown", (event) => { stage.setPointerCapture(event.pointerId); drag(event); });
    stage.addEventListener("pointermove", drag);
  });

  all(".enlarge").forEach((button) => button.addEventListener("click", () => {
    const large = button.parentElement.classList.toggle("large");
    button.setAttribute("aria-expanded", String(large));
    button.parentElement.scrollIntoView({ block: "nearest" });
  }));
  all(".copy").forEach((button) => button.addEventListener("click", async () => {
    await navigator.clipboard.writeText(button.parentElement.querySelector("code").textContent);
    button.textContent = "Copied";
    setTimeout(() => { button.textContent = "Copy"; }, 1500);
  }));
  addEventListener("beforeprint", () => all("details").forEach((details) => { details.open = true; }));

  // A browser that goes back to the page keeps what was chosen.
  const chosen = (name) => document.querySelector(`input[name=${name}]:checked`);
  other(chosen("other"));
  choose(chosen("mode").value);
  line();
  tiles();
})();
