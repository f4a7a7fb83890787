// What scrolls by itself is reached with the keyboard.
addEventListener("load", () => {
  for (const element of document.querySelectorAll(".highlight pre, .table-wrapper, .math-wrapper, .output pre, .content p")) {
    if (element.scrollWidth > element.clientWidth) element.tabIndex = 0;
  }
});
