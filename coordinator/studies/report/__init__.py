"""Reports: a mission run or a campaign as one self-contained HTML page with SVG pictures; two
campaigns compared."""

from petrobot.coordinator.studies.report.run_page import report_html as report_html
