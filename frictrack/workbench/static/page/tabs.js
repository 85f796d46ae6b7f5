// The views of the page, in their order.

export const TABS = [
  { name: "film", title: "Film" },
  { name: "compare", title: "Compare" },
  { name: "motion", title: "Motion" },
  { name: "model", title: "Model" },
  { name: "history", title: "History" },
];
